"""Bones on a grid: labels, motions, joints and weights, the alternation of the paper."""
