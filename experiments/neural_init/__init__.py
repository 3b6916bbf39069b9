"""A worked example: a small PointNet that regresses hand poses from clouds, with torchreg's help in four ways.

Read `train` first: each variant is a few lines.
"""
