"""Readers of point clouds and meshes, one file per format, and what the columns of tables mean."""
