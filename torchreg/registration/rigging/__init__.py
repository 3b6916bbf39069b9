"""Rigs of sequences: one skinned shape and its poses from meshes that share nothing."""
