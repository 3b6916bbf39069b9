"""Cameras to geometry: depth images, silhouettes and stereo pairs; the place of kornia and of image processing."""
