"""The only place that opens files; returns plain records, never models."""
