"""Small bodies that tests of several systems share, and a registration of seconds."""

from dataclasses import replace

import numpy as np
import torch

import torchreg as tr
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive

DEFAULT = tr.RegisterConfig()
QUICK = replace(DEFAULT, align=replace(DEFAULT.align, num_samples=100, num_nodes=20), num_samples=100)


def finger(dtype=None, unit=1.0):
    """A body with a finger on a hinge, cheap to search, in units of a metre."""
    eye = torch.eye(4, dtype=torch.float64)
    knuckle = eye.clone()
    knuckle[2, 3] = 0.05 * unit
    hinge = Joint("finger", 0, knuckle, "revolute", (0.8, 0.6, 0.0), -0.5, 1.2)
    solids = [
        Primitive("ellipsoid", tuple(unit * axis for axis in axes), eye)
        for axes in ((0.05, 0.03, 0.06), (0.012, 0.015, 0.04))
    ]
    tree = KinematicTree((Joint("body", -1, eye), hinge))
    return tr.ArticulatedShape(tree, ["body", "finger"], solids, nu=0.004 * unit, dtype=dtype)


def bent_tube(bend, rings=25, sides=9):
    """Vertices and faces, float64, of the upper side of a tube of several radii that bends in its middle."""
    along, around = np.meshgrid(np.linspace(0, 1.2, rings), np.linspace(0.2, np.pi - 0.2, sides), indexing="ij")
    angle = bend * np.clip((along - 0.6) / 0.1, 0, 1)
    steps = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1) * 1.2 / (rings - 1)
    middle = np.cumsum(steps, 0) - steps
    radius = 0.12 * (1 + 0.25 * np.sin(6 * along))
    side = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1) * np.cos(around)[..., None]
    points = middle + radius[..., None] * (side + np.array([0, 0.7, 0]) * np.sin(around)[..., None])
    index = np.arange(rings * sides).reshape(rings, sides)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, d, c], -1).reshape(-1, 3), np.stack([a, c, b], -1).reshape(-1, 3)])
    return torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(faces)
