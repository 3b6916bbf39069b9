"""Articulated alignment: the pose of a shape in 3-D points."""
