"""The kinds of shapes that the tests of this room share, and poses and points for them."""

import math

import torch

import torchreg as tr
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.io.gltf_write import save_animated_skin
from torchreg.shapes.primitives import Primitive

D = torch.float64
ROTATIONS = {
    "zero": (0.0, 0.0, 0.0),
    "tiny": (1e-9, -2e-9, 1e-9),
    "small": (0.01, -0.02, 0.005),
    "ordinary": (0.4, -0.7, 1.1),
    "nearly pi": (0.0, math.pi - 1e-6, 0.0),
    "pi": (math.pi / math.sqrt(2), 0.0, -math.pi / math.sqrt(2)),
    "beyond pi": (2.5, 2.5, 0.0),
    "nearly 2 pi": (0.0, 0.0, 2 * math.pi - 1e-3),
}
ROBOT = """<?xml version="1.0"?>
<robot name="crane">
  <link name="base"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual></link>
  <link name="mast"><visual><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.4"/></geometry></visual>
  </link>
  <link name="boom"><visual><origin xyz="0.2 0 0" rpy="0 1.5 0"/><geometry><cylinder radius="0.03" length="0.4"/>
    </geometry></visual></link>
  <link name="hook"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>
  <link name="camera"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="mast"/><origin xyz="0.05 0 0.05" rpy="0 0 1"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="camera" type="fixed"><parent link="base"/><child link="camera"/><origin xyz="0.1 0 0"/></joint>
  <joint name="tilt" type="revolute"><parent link="mast"/><child link="boom"/><origin xyz="0 0 0.4" rpy="0.25 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="boom"/><child link="hook"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.25" effort="1" velocity="1"/></joint>
</robot>
"""


def seeded(*size, seed=0):
    return torch.randn(size, dtype=D, generator=torch.Generator().manual_seed(seed))


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    """The transform (4, 4) of a translation and a rotation vector."""
    frame = torch.eye(4, dtype=D)
    frame[:3, :3] = so3_exp(torch.as_tensor(turn, dtype=D))
    frame[:3, 3] = torch.tensor([x, y, z], dtype=D)
    return frame


def machine(dtype=D, order=range(5), **options):
    """A tree with every kind of joint and solid, a mimic joint, and a frame without a solid."""
    joints = (
        Joint("base", -1, at(0.1, 0.0, 0.2)),
        Joint("turn", 0, at(0.0, 0.0, 0.5), "revolute", (0.0, 0.0, 1.0), -2.0, 2.0),
        Joint("lift", 1, at(0.2, 0.0, 0.0), "revolute", (0.0, 0.6, 0.8), -1.0, 1.0),
        Joint("slide", 2, at(0.0, 0.0, 0.6), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.5),
        Joint("hook", 3, at(0.0, 0.1, 0.3), "revolute", (1.0, 0.0, 0.0)),
        Joint("follow", 3, at(0.0, -0.1, 0.3), "revolute", (1.0, 0.0, 0.0), mimic=(4, -0.5, 0.2)),
    )
    solids = {
        "base": Primitive("cone", (0.25, 0.3, 0.2), at(0.0, 0.0, 0.25)),
        "lift": Primitive("ellipsoid", (0.1, 0.15, 0.35), at(0.0, 0.02, 0.3)),
        "slide": Primitive("superquadric", (0.1, 0.12, 0.2, 0.6, 0.8), at(0.0, 0.0, 0.1)),
        "hook": Primitive("capsule", (0.1, 0.05), at(0.0, 0.0, 0.1)),
        "follow": Primitive("ellipsoid", (0.05, 0.05, 0.15), at(0.0, 0.0, 0.1)),
    }
    frames = [list(solids)[part] for part in order]
    options = {"nu": 0.05, **options}
    return tr.ArticulatedShape(KinematicTree(joints), frames, [solids[f] for f in frames], dtype=dtype, **options)


def rod(dtype=D, **options):
    """Two links on a hinge, the solid of the second oblique to it."""
    tree = KinematicTree((Joint("a", -1, at()), Joint("b", 0, at(z=0.1), "revolute", (1.0, 0.0, 0.0), -1.0, 1.0)))
    solids = [
        Primitive("capsule", (0.05, 0.02), at(z=0.05)),
        Primitive("ellipsoid", (0.02, 0.015, 0.05), at(z=0.05, turn=(0.4, -0.2, 0.3))),
    ]
    return tr.ArticulatedShape(tree, ["a", "b"], solids, **{"nu": 0.004, **options}, dtype=dtype)


def robot(folder, text=ROBOT, **options):
    path = folder / "crane.urdf"
    path.write_text(text)
    return tr.ArticulatedShape.from_urdf(path, **{"dtype": D, **options})


def rig(folder):
    """A bar with a ball joint and a hinge, whose joint frames are turned, read from a glTF file."""
    ball = unit_sphere(3, dtype=D)
    vertices = ball.vertices * torch.tensor([0.3, 0.05, 0.05], dtype=D)
    first, second = torch.sigmoid(40 * (vertices[:, 0] + 0.1)), torch.sigmoid(40 * (vertices[:, 0] - 0.1))
    weights = torch.stack([1 - first, first * (1 - second), first * second], dim=-1)
    frames = torch.stack([at(x, turn=row) for x, row in zip((-0.3, -0.1, 0.1), seeded(3, 3, seed=1), strict=True)])
    save_animated_skin(
        folder / "rig.glb", vertices, ball.faces, weights / weights.sum(-1, keepdim=True), ["hip", "knee", "foot"],
        [-1, 0, 1], frames, frames[None], torch.zeros(1),
    )  # fmt: skip
    return tr.ArticulatedShape.from_gltf(folder / "rig.glb", axes={"foot": ["z"]}, dtype=D)


def tube(dtype=D):
    """Arrays of a tube along z: three bones, weights that blend over 2 cm, and a joint that carries nothing."""
    sphere = unit_sphere(2, dtype=dtype)
    vertices = sphere.vertices * torch.tensor([0.03, 0.02, 0.15], dtype=dtype) + torch.tensor([0, 0, 0.15], dtype=dtype)
    joints = torch.tensor([[0.0, 0, 0], [0, 0, 0.1], [0, 0, 0.2], [0, 0, 0.3]], dtype=dtype)
    bend = ((vertices[:, 2:] - joints[1:3, 2]) / 0.02 + 0.5).clamp(0, 1)
    weights = torch.stack([1 - bend[:, 0], bend[:, 0] - bend[:, 1], bend[:, 1], torch.zeros_like(bend[:, 0])], dim=-1)
    return vertices, sphere.faces, weights, joints


KINDS = {
    "hand": lambda folder: tr.Hand(dtype=D),
    "left hand": lambda folder: tr.Hand("left", scale=0.6, nu=0.002, sharpness=3.0, dtype=D),
    "machine": lambda folder: machine(),
    "rod": lambda folder: rod(),
    "robot": robot,
    "rig": rig,
    "tube": lambda folder: tr.ArticulatedShape.from_skinned_mesh(*tube(), [-1, 0, 1, 2], dtype=D),
}


def poses_of(shape, count=3, seed=0, turn=1.0):
    """Poses (count, D) within the limits, in the dtype of the shape."""
    lower, upper = shape.lower[6:].clamp_min(-1).to(D), shape.upper[6:].clamp_max(1).to(D)
    share = torch.rand(count, shape.num_dofs - 6, dtype=D, generator=torch.Generator().manual_seed(seed))
    base = seeded(count, 6, seed=seed) * torch.tensor([0.1] * 3 + [turn] * 3, dtype=D)
    return torch.cat([base, lower + share * (upper - lower)], dim=-1).to(shape.rest)


def rotated(pose, names=tuple(ROTATIONS)):
    """Copies of a pose (D,) with other rotations of the base."""
    poses = pose.repeat(len(names), 1)
    poses[:, 3:6] = torch.tensor([ROTATIONS[name] for name in names], dtype=D)
    return poses


def around(shape, pose, count=40, seed=0):
    """Points (..., count, 3) about the keypoints of poses, inside and outside."""
    keypoints = shape.keypoints(pose).detach()
    chosen = torch.randint(keypoints.shape[-2], (count,), generator=torch.Generator().manual_seed(seed))
    spread = 0.4 * shape.keypoints(shape.rest_pose()).detach().std(0).max()
    return keypoints[..., chosen, :] + spread * seeded(count, 3, seed=seed).to(keypoints)


def perturbed(shape, seed=0, spread=0.1):
    """Change all parameters of a shape, in place."""
    with torch.no_grad():
        for number, value in enumerate(shape.parameters()):
            value.add_(spread * seeded(*value.shape, seed=seed + number).to(value))
    return shape


def compare(found, expected, **tolerance):
    """Assert that tensors, or tuples of them, are close."""
    torch.testing.assert_close(tuple(found), tuple(expected), **{"atol": 1e-12, "rtol": 0, **tolerance})
