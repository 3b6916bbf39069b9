"""The pose of a shape over time."""
