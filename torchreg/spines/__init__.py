"""Spines: one branching graph of curves from surfaces that share nothing.

Besides the public names, other rooms may use `TipReference` and `rank_mappings`, `points_along`, `path_lengths` and
`FrameSurfaces`.
"""
