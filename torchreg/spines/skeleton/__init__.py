"""The skeleton of one surface: its tips, level sets, the tree that joins them, and the curves of its limbs."""
