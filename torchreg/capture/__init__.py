"""Cameras to geometry: depth images, silhouettes and stereo pairs; with image processing by kornia."""
