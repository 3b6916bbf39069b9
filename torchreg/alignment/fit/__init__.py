"""The fits of poses to data: annealed EM, surface distances, further factors."""
