"""Limbs of the common graph in every frame: observed, or transferred from frames that show them."""
