"""Spines: one branching graph of curves from surfaces that share nothing."""
