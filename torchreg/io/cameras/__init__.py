"""Readers of cameras of other programs: lenses, entries of JSON, COLMAP, OpenCV."""
