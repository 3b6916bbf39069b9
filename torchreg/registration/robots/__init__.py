"""Robots out of registered scans: links, joints, and their motions fitted to the scans again."""
