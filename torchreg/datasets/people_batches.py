"""Made-up clouds of people in batches: any size and pose, bare and clothed, of one side or all; to learn from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.datasets.cloud_batches import CloudBatch, CloudDraw
from torchreg.datasets.cloud_clutter import Clutter
from torchreg.datasets.people_poses import people_states
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shaped import ShapedSkin, ShapedTree, blended


@dataclass(frozen=True)
class _Variety:
    """What differs between clouds of people; lengths in metres."""

    samples: int = 2000  # vertices of which clouds are drawn
    clothed: float = 0.4  # of the people
    cloth: tuple[float, float] = (0.005, 0.06)  # largest distance of a garment from the skin
    hair: float = 0.05  # the same of hair
    folds: float = 0.35  # standard deviation of the logarithm of the distance
    fold: float = 0.12  # size of folds
    waves: int = 24  # of which folds are the sum
    held: float = 0.2  # of the people, with a thing that touches them
    held_points: tuple[float, float] = (0.05, 0.5)  # of such a thing, for each of a person
    whole: float = 0.25  # of the clouds, measured from all sides
    elevation: tuple[float, float] = (-25.0, 60.0)  # of the camera, degrees
    cut: float = 0.25  # of the clouds, of which a plane cuts a part off
    least_left: float = 0.5  # share of the points that is left then, at least
    disturbed: float = 0.6  # of the size, by which holes and noise are scaled: half of the people are small


_VARIETY = _Variety()
# What the names of the parts begin with that one garment covers.
_GARMENTS = (
    ("pelvis", "spine", "clavicle", "shoulder", "breast"), ("upperarm", "lowerarm"), ("upperleg", "lowerleg"),
    ("head", "neck"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class PeopleBatch(CloudBatch):
    """Clouds of people: poses are states (B, D + K), marks their places (B, P, 3), sizes at rest (B,), metres."""

    marks: Tensor
    sizes: Tensor


class PeopleBatches:
    """Draws states of people and clouds of them.

    Args:
        body: in metres, with coefficients, its parts named as anny's.
        marks: (P,) vertices whose places are told of every person.
    """

    def __init__(self, body: ArticulatedShape, marks: Tensor) -> None:
        surface, space = body.file_surface(), body.coefficient_space()
        self.body, tree = body, ShapedTree(body, space)
        at_mean = space.rest(space.mean)[0]
        self.index = farthest_points(at_mean, _VARIETY.samples)
        weights = surface.weights.to(at_mean)
        both = torch.cat([self.index, marks])
        self.skin = ShapedSkin(tree, both.unsqueeze(-1), torch.ones_like(both[:, None]).to(at_mean), weights[both])
        self.rest = at_mean[self.index]
        self.normals = TriangleMesh(at_mean, surface.faces).vertex_normals()[self.index]
        covers = torch.tensor([[name.startswith(parts) for parts in _GARMENTS] for name in body.part_names])
        self.covers = weights[self.index] @ covers.to(weights)

    def clouds(self, count: int, num_points: int, generator: torch.Generator, size: float) -> PeopleBatch:
        """Return clouds of random people of about a size, metres; the index tells of the samples `rest`."""
        states = people_states(self.body, count, generator)
        posed = self.skin.shape.posed(states, self.skin.space)
        points, blend = blended(posed, self.skin.weights, posed.vertices[..., self.skin.corners[:, 0], :])
        extent = (posed.vertices.amax(1) - posed.vertices.amin(1)).norm(dim=-1)
        points = points - points[:, : len(self.index)].mean(1, keepdim=True)
        surface, marks = points.split([len(self.index), points.shape[1] - len(self.index)], dim=1)
        normals = normalize((blend[:, : len(self.index)] @ self.normals.unsqueeze(-1)).squeeze(-1), dim=-1)
        draw = CloudDraw(generator, surface, size, 0.0)
        surface = surface + self._cloth(draw).unsqueeze(-1) * normals
        held, facing = Clutter(generator, surface, size).held(surface, normals)
        points, normals = torch.cat([surface, held], dim=1), torch.cat([normals, facing], dim=1)
        often = draw.between(_VARIETY.held_points, count, 1) * surface.shape[1] / held.shape[1]
        often = torch.where(draw.uniform(count, 1) < _VARIETY.held, often, 0.0)
        shown = torch.cat([torch.ones_like(surface[..., 0]), often.expand(-1, held.shape[1])], dim=1)
        view = _cameras(draw, count)
        visible, slant = draw.visible(points @ view.mT, normals @ view.mT)
        whole = draw.uniform(count, 1) < _VARIETY.whole
        weight = shown * torch.where(whole, 1.0, torch.where(visible, slant, 0.0)) * _uncut(draw, points)
        picked, index = draw.picked(weight, num_points)
        draw = replace(draw, size=_VARIETY.disturbed * size)
        cloud, outlier = draw.disturbed(points.gather(1, index.unsqueeze(-1).expand(-1, -1, 3)))
        truth = torch.where(outlier | (index >= surface.shape[1]), -1, index)
        return PeopleBatch(cloud, picked & draw.kept(cloud), states, truth, marks, extent)

    def _cloth(self, draw: CloudDraw) -> Tensor:
        """Return how far clothes and hair lie off the skin (B, S), metres; of bare people nowhere."""
        count, garments = len(draw.like), len(_GARMENTS)
        most = torch.cat(
            [draw.between(_VARIETY.cloth, count, garments - 1), _VARIETY.hair * draw.uniform(count, 1)], dim=1
        )
        # A garment that is not worn lies nowhere.
        worn = (draw.uniform(count, 1) < _VARIETY.clothed) & (draw.uniform(count, garments) < 0.8)
        waves = draw.normal(count, 3, _VARIETY.waves) / _VARIETY.fold
        phases = (self.rest @ waves + math.tau * draw.uniform(count, 1, _VARIETY.waves)).cos().sum(-1)
        folds = math.sqrt(2 / _VARIETY.waves) * phases
        return torch.where(worn, most, 0.0) @ self.covers.mT * (_VARIETY.folds * folds).exp()


def _cameras(draw: CloudDraw, count: int) -> Tensor:
    """Return rotations (count, 3, 3) into cameras that look along +z at people who stand along z."""
    azimuth = math.tau * draw.uniform(count)
    low, high = map(math.radians, _VARIETY.elevation)
    elevation = low + (high - low) * draw.uniform(count)
    across, level = torch.stack([-azimuth.sin(), azimuth.cos(), 0 * azimuth], -1), elevation.cos().unsqueeze(-1)
    flat = torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], -1)
    ahead = -level * flat - torch.nn.functional.pad(elevation.sin().unsqueeze(-1), (2, 0))
    return torch.stack([across, torch.linalg.cross(ahead, across), ahead], dim=-2)


def _uncut(draw: CloudDraw, points: Tensor) -> Tensor:
    """Return which points (B, N) no plane cuts off."""
    count = len(points)
    along = (points * normalize(draw.normal(count, 1, 3), dim=-1)).sum(-1)
    left = _VARIETY.least_left + (1 - _VARIETY.least_left) * draw.uniform(count, 1)
    rank = (left * (points.shape[1] - 1)).long()
    limit = along.sort(dim=1).values.gather(1, rank)
    return (along <= limit) | (draw.uniform(count, 1) > _VARIETY.cut)
