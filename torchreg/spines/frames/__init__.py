"""Frames of a sequence: their surfaces and skeletons, computed in parallel, and which of them are outliers."""
