"""Spines of Brostow et al. 2004 as printed; the defaults differ."""
