"""Spines of Brostow et al. 2004 as printed, beside what is done by default."""
