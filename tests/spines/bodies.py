"""Bodies, skeletons and motions of which the tests of spines know the truth."""

import weakref
from collections.abc import Sequence

import torch

import torchreg as tr
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import build_skeleton

STAR = "(()()()()())"  # the topology of a starfish


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def shuffled(count, seed):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


def line(start, end, count=60):
    """Return points (count, 3) from one point to another."""
    start, end = torch.tensor(start).double(), torch.tensor(end).double()
    return start + torch.linspace(0, 1, count).double()[:, None] * (end - start)


def circle(radius=1.0, count=200, turn=(0.0, 1.0), z=0.0):
    """Return points (count, 3) of an arc in the plane z, from and to a share of a full turn."""
    angle = 2 * torch.pi * torch.linspace(*turn, count).double()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z + 0 * angle), dim=1)


def tube(axis, radius, spacing=0.07):
    """Return the surface of the union of balls around points (n, 3), of one radius or n of them."""
    radius = torch.as_tensor(radius, dtype=torch.float64).expand(len(axis))
    margin = float(radius.max()) + 2 * spacing
    return isosurface(
        lambda points: (torch.cdist(points, axis) - radius).amin(1),
        axis.amin(0) - margin, axis.amax(0) + margin, spacing,
    )  # fmt: skip


def with_mixed_winding(mesh):
    """Return the mesh with every second face turned over."""
    faces = mesh.faces.clone()
    faces[::2] = faces[::2].flip(1)
    return tr.TriangleMesh(mesh.vertices, faces)


def similarity(seed, scale=1.0):
    """Return a motion with scale, (4, 4)."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = scale * so3_exp(3 * random(3, seed=seed))
    matrix[:3, 3] = 10 * scale * random(3, seed=seed + 100)
    return matrix


def moved(points, matrix):
    """Return points (..., 3) moved by a matrix (4, 4), in the dtype of the points."""
    matrix = matrix.to(points)
    return points @ matrix[:3, :3].mT + matrix[:3, 3]


def arms_skeleton(sequence, frame, arms=range(5), extra=None, notes=()):
    """Return the true axes of a creature's arms as a skeleton whose tips come in the order of the arms, float64.

    ``extra`` is the tip of one more limb.
    """
    curves = sequence.curves[frame].double()
    limbs = [(curves[int(arm)].flip(0), sequence.radii[int(arm)].double().flip(0)) for arm in arms]
    if extra is not None:
        limbs.append((torch.stack((extra.double(), curves[0, 0])), torch.full((2,), 0.1).double()))
    rows = [(limb, radii, torch.eye(3).double().expand(len(limb), 3, 3)) for limb, radii in limbs]
    return build_skeleton(rows, [(k, 99) for k in range(len(rows))], notes)


def star_skeleton(tips):
    """Return a skeleton of straight limbs from the origin to tips (K, 3)."""
    nodes = torch.cat((tips, torch.zeros(1, 3).to(tips)))
    edges = torch.tensor([[k, len(tips)] for k in range(len(tips))])
    return tr.Skeleton(nodes, edges, torch.full((len(nodes),), 0.1).to(tips))


def nearest_arms(spine, sequence):
    """Return the arm (T, K) whose true tip is nearest to each tip, and the distances."""
    distance, arm = torch.cdist(spine.tips.double(), sequence.tips.double()).min(-1)
    return arm, distance


def without_arm(sequence, frame, arm):
    """Return the surface of a frame with an arm cut off, which leaves a hole."""
    mesh, axis = sequence.meshes[frame], sequence.curves[frame, arm]
    ahead = (mesh.vertices - axis[12]) @ (axis[20] - axis[0]) > 0
    outer = (torch.cdist(mesh.vertices, axis[12:]).amin(1) < 0.3) & ahead
    return tr.TriangleMesh(mesh.vertices, mesh.faces[~outer[mesh.faces].any(-1)])


class MeshesOnRequest(Sequence):
    """Meshes that are made when they are asked for; counts those that are alive at once. Some cannot be read."""

    def __init__(self, meshes, unreadable=()):
        self.rows, self.unreadable = [(mesh.vertices, mesh.faces) for mesh in meshes], unreadable
        self.alive, self.most, self.asked = weakref.WeakSet(), 0, 0

    def __len__(self):
        return len(self.rows)

    def __getitem__(self, index):
        if index in self.unreadable:
            raise KeyboardInterrupt
        mesh = tr.TriangleMesh(*(part.clone() for part in self.rows[index]))
        self.alive.add(mesh)
        self.most, self.asked = max(self.most, len(self.alive)), self.asked + 1
        return mesh
