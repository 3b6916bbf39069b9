"""Sweeps of torchreg's systems: run them, survive crashes, scale out, and read the answer in a report."""
