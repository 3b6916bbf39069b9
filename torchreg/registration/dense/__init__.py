"""Where every point of a scan goes: matching, hypotheses and EM on a deformation graph."""
