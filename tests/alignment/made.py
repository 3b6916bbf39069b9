"""Shapes and data that several tests make: trees of solids by a line a joint, poses, clouds, problems."""

import math

import torch

import torchreg as tr
from torchreg.alignment.fit.problem import centered_problem
from torchreg.datasets.hand import make_hand_cloud
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import sample_surface
from torchreg.shapes.primitives import Primitive

D = torch.float64
TIPS = [4, 8, 12, 16, 20]

ARM = """<robot name="arm">
  <link name="base"><visual><origin xyz="0.02 0 0.1"/><geometry><box size="0.16 0.1 0.2"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0.03 0 0.15"/><geometry><box size="0.06 0.09 0.3"/></geometry></visual></link>
  <link name="lower"><visual><origin xyz="0 .04 .12"/><geometry><box size="0.05 0.07 0.24"/></geometry></visual></link>
  <link name="tool"><visual><origin xyz="0 0.02 0.08"/><geometry><box size="0.12 0.04 0.08"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 1 0"/><limit lower="-2.2" upper="2.2" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="lower"/><child link="tool"/><origin xyz="0 0 0.24"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def offset(*place):
    pose = torch.eye(4, dtype=D)
    pose[:3, 3] = torch.tensor(place, dtype=D)
    return pose


def joint(name, parent, place=(0, 0, 0), *motion, **options):
    return Joint(name, parent, offset(*place), *motion, **options)


def solid(kind, sizes, *place):
    return Primitive(kind, tuple(sizes), offset(*(place or (0, 0, 0))))


def shape_of(joints, solids, frames=None, **options):
    """Return a shape without gradients; by default every joint's frame carries a solid."""
    tree = KinematicTree(tuple(joints))
    frames = frames or [each.name for each in joints]
    return tr.ArticulatedShape(tree, frames, solids, **({"nu": 0.01} | options)).requires_grad_(False)


def hinge(axis=(1.0, 0.0, 0.0), reach=1.8):
    return "revolute", axis, -reach, reach


def machine(**options):
    """Return a mast, a carriage that slides up on it and a hinged arm, all of unlike sizes."""
    joints = [
        joint("mast", -1),
        joint("carriage", 0, (0.15, 0, 0.2), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.5),
        joint("arm", 1, (0.1, 0, 0), *hinge((0.0, 1.0, 0.0), 1.5)),
    ]
    solids = [
        solid("superquadric", (0.06, 0.09, 0.5, 0.5, 0.5), 0, 0, 0.5), solid("ellipsoid", (0.12, 0.1, 0.08)),
        solid("cone", (0.2, 0.07, 0.04), 0, 0, 0.2),
    ]  # fmt: skip
    return shape_of(joints, solids, **options)


def finger(**options):
    """Return a lopsided body with a hinge: seven degrees of freedom."""
    joints = [joint("body", -1), joint("finger", 0, (0.03, 0, 0.05), "revolute", (0.8, 0.6, 0.0), -0.5, 1.2)]
    solids = [solid("ellipsoid", (0.05, 0.03, 0.06)), solid("ellipsoid", (0.012, 0.015, 0.04), 0, 0, 0.04)]
    return shape_of(joints, solids, **({"nu": 0.004, "dtype": D} | options))


def cloud(hand, pose, seed=0, **options):
    """Return a hand's cloud, by default 400 points of all sides with 1 mm noise."""
    options = {"num_points": 400, "noise": 0.001, "outlier_ratio": 0.0} | options
    return make_hand_cloud(hand, pose, generator=generator(seed), **options)


def person_cloud(shape, pose, coefficients, generator, count, *, one_sided=True, noise=0.002):
    """Return points of a person on what faces a camera at -y, or all sides, with noise and 5 % outliers."""
    mesh = tr.TriangleMesh(shape.vertices(pose, coefficients), shape.surface.faces)
    points, face, _ = sample_surface(mesh, 4 * count, generator=generator)
    points = points[mesh.face_normals()[face][:, 1] < -0.1] if one_sided else points
    points = points[:count] + noise * torch.randn(count, 3, generator=generator)
    low, high = points.amin(0) - 0.2, points.amax(0) + 0.2
    return torch.cat([points, low + (high - low) * torch.rand(count // 20, 3, generator=generator)])


def person_pose(shape, generator):
    """Return a pose of a person a metre away whose limbs are bent by some 12 degrees."""
    pose = shape.rest_pose()
    pose[6:] = math.radians(12) * torch.randn(len(pose) - 6, generator=generator)
    pose[:6] = torch.tensor([0.3, -0.2, 0.9, 0.1, -0.1, 0.15])
    return pose


def off(shape, poses, truths):
    """Return the distances of the keypoints from their true places."""
    return (shape.keypoints(poses) - shape.keypoints(truths)).norm(dim=-1)


def problem_of(skin, data, pose, valid=None, origin=None, prior_std=0.4, **options):
    """Return a problem of data (B, M, 3) whose prior's mean is a pose, in coordinates from the origins."""
    valid = torch.ones_like(data[..., 0], dtype=torch.bool) if valid is None else valid
    origin = torch.zeros_like(data[:, 0]) if origin is None else origin
    return centered_problem(skin, data, valid, pose, origin, **({"prior_std": prior_std, "pose_atol": 0.0} | options))
