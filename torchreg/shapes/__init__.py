"""Articulated shapes: `nn.Module`s from a pose to parts, surface and skin, and what files and robots give for them."""
