"""Poses to start from: all around, around a start, limb by limb, by a network, in a whole picture."""
