"""Bodies, skeletons and motions of which the tests of spines know the truth."""

import weakref
from collections.abc import Sequence

import torch

import torchreg as tr
from tests.geometry.draws import randn as random
from tests.geometry.draws import seeded
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import build_skeleton

STAR = "(()()()()())"  # the topology of a starfish


def shuffled(count, seed):
    return torch.randperm(count, generator=seeded(seed))


def line(start, end, count=60):
    """Points (count, 3) from one point to another."""
    start, end = torch.tensor(start).double(), torch.tensor(end).double()
    return start + torch.linspace(0, 1, count).double()[:, None] * (end - start)


def circle(radius=1.0, count=200, turn=(0.0, 1.0), z=0.0):
    """Points (count, 3) of an arc in the plane z, from and to a share of a full turn."""
    angle = 2 * torch.pi * torch.linspace(*turn, count).double()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z + 0 * angle), dim=1)


def tube(axis, radius, spacing=0.07):
    """The surface of the union of balls around points (n, 3), of one radius or n of them."""
    radius = torch.as_tensor(radius, dtype=torch.float64).expand(len(axis))
    margin = float(radius.max()) + 2 * spacing
    lower, upper = axis.amin(0) - margin, axis.amax(0) + margin
    return isosurface(lambda points: (torch.cdist(points, axis) - radius).amin(1), lower, upper, spacing)


def with_mixed_winding(mesh):
    """Return the mesh with every second face turned over."""
    faces = mesh.faces.clone()
    faces[::2] = faces[::2].flip(1)
    return tr.TriangleMesh(mesh.vertices, faces)


def similarity(seed, scale=1.0):
    """A motion with scale, (4, 4)."""
    return rigid_matrix(scale * so3_exp(3 * random(3, seed=seed)), 10 * scale * random(3, seed=seed + 100))


def turn_matrix(*entries):
    """A rotation by the matrix exponential of three entries above the diagonal."""
    upper = torch.zeros(3, 3, dtype=torch.float64)
    upper[[0, 0, 1], [1, 2, 2]] = torch.tensor(entries, dtype=torch.float64)
    return torch.linalg.matrix_exp(upper - upper.mT)


def moved(points, matrix):
    return transform_points(matrix.to(points), points)


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
    """Straight limbs from the origin to tips (K, 3)."""
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
