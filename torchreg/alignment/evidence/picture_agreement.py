"""How a whole picture agrees with a posed shape: its visible surface, limb by limb, its normals, its relief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import limb_points
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.neighbors import k_nearest_others
from torchreg.geometry.normals import fit_normals


@dataclass(frozen=True)
class _Look:
    """How surfaces are compared; lengths are shares of the shape's size."""

    on_shape: float = 0.03  # distance of data on the shape: a fit of another hand errs by .02
    facing: float = 0.3  # cosine between a normal and the direction to the camera from which on a surface is visible
    ray: tuple[float, ...] = (
        0.04,
        0.07,
        0.12,
        0.2,
        0.35,
        0.6,
    )  # steps to the camera in which the shape may hide itself
    least: int = 4  # visible points of a limb that say whether it is in the picture
    num_data: int = 800  # whose normals are compared
    detail: float = 0.12  # radius within which normals are compared with their mean
    neighbors: int = 24  # that give the mean


_LOOK = _Look()


@dataclass(frozen=True, eq=False)
class PictureAgreement:
    """Agreement of pictures with poses, (B,) each, from 0 to 1 unless said.

    Args:
        agrees: share of the shape's visible surface where the picture has it.
        behind: share of it through which the picture shows something farther.
        hidden: share of it before which the picture shows something nearer.
        weakest: `agrees` of the limb that agrees least, those that the picture does not show left out.
        limbs: share of all limbs of which half agrees or more.
        normals: mean cosine between the normals of data and shape.
        relief: correlation of the details of their normals, from -1 to 1: smooth things have none.
        amplitude: logarithm of the data's details over the shape's.
        covered: area that data on the shape show, as a share of the surface that would be visible.
    """

    agrees: Tensor
    behind: Tensor
    hidden: Tensor
    weakest: Tensor
    limbs: Tensor
    normals: Tensor
    relief: Tensor
    amplitude: Tensor
    covered: Tensor

    def table(self) -> Tensor:
        """Return the numbers as (B, E)."""
        return torch.stack([getattr(self, item.name) for item in fields(self)], dim=-1)

    @classmethod
    def of(cls, problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]) -> PictureAgreement:
        """Return how frames, one for each of poses (B, num_dofs), agree with them."""
        rows = [
            _agreement(problem.rows(torch.tensor([row])), pose[row, None], frame) for row, frame in enumerate(frames)
        ]
        table = torch.stack([torch.stack(row) for row in rows])
        return cls(*table.unbind(-1))


def _agreement(problem: AlignProblem, pose: Tensor, frame: DepthFrame) -> list[Tensor]:
    """Return the numbers of one pose (1, num_dofs) in a frame."""
    posed = problem.skin(pose)
    normal = _shape_normals(problem, pose, posed)[0]
    posed = posed[0]
    eye = frame.camera.position.to(posed) - problem.origin[0].to(posed)
    toward = torch.nn.functional.normalize(eye - posed, dim=-1)
    visible = (normal * toward).sum(-1) > _LOOK.facing
    steps = problem.size * posed.new_tensor(_LOOK.ray)
    rays = posed + steps[:, None, None] * toward
    inside = problem.surface.distance(rays.reshape(1, -1, 3), pose).reshape(len(steps), -1)
    visible &= (inside > 0).all(0)
    pixels, depth = frame.camera.project(posed.double() + problem.origin[0].double())
    column, row = pixels.nan_to_num(-1).round().long().unbind(-1)
    height, width = frame.depth.shape
    framed = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = frame.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    gap = (measured - depth.to(measured)) / problem.size
    known = visible & framed & (measured > 0)
    agrees, behind, hidden = (
        known & flag for flag in (gap.abs() <= _LOOK.on_shape, gap > _LOOK.on_shape, gap < -_LOOK.on_shape)
    )
    count = known.sum().clamp_min(1)
    shares = [
        (agrees[index].sum() / known[index].sum(), bool(known[index].sum() >= _LOOK.least))
        for _, index in limb_points(problem.skin)
    ]
    shown = torch.stack([share for share, is_known in shares if is_known] or [agrees.sum() / count])
    data = _data_details(problem, pose, frame)
    number = [
        agrees.sum() / count,
        behind.sum() / count,
        hidden.sum() / count,
        shown.amin(),
        (shown > 0.5).sum() / max(1, len(shares)),
    ]
    return [value.to(pose) for value in (*number, *data, agrees.sum() / visible.sum().clamp_min(1))]


def _shape_normals(problem: AlignProblem, pose: Tensor, points: Tensor) -> Tensor:
    """Return unit normals (1, N, 3) of the surface next to points (1, N, 3): the base's translation moves it so."""
    slope = -problem.surface.distance_jacobian(points, pose)[1][..., :3]
    return torch.nn.functional.normalize(slope, dim=-1)


def _data_details(problem: AlignProblem, pose: Tensor, frame: DepthFrame) -> list[Tensor]:
    """Return agreement of normals, correlation of their details, and logarithm of their amplitudes."""
    data = problem.data[0][problem.valid[0]]
    on_shape = problem.surface.distance(data[None], pose)[0].abs() < _LOOK.on_shape * problem.size
    data = data[on_shape]
    if len(data) <= _LOOK.neighbors:
        return [data.new_zeros(()), data.new_zeros(()), data.new_zeros(())]
    stride = -(-len(data) // _LOOK.num_data)
    normals = fit_normals(data.double(), k_nearest_others(data.double(), 16)[0]).to(data)
    data, normals = data[::stride], normals[::stride]
    eye = frame.camera.position.to(data) - problem.origin[0].to(data)
    normals = torch.where(((eye - data) * normals).sum(-1, keepdim=True) < 0, -normals, normals)
    expected = _shape_normals(problem, pose, data[None])[0]
    index, apart = k_nearest_others(data, min(_LOOK.neighbors, len(data) - 1))
    near = (apart < _LOOK.detail * problem.size).to(data).unsqueeze(-1)
    details = [values - (values + (values[index] * near).sum(1)) / (1 + near.sum(1)) for values in (normals, expected)]
    squares = [detail.square().sum().clamp_min(1e-9) for detail in details]
    relief = (details[0] * details[1]).sum() / (squares[0] * squares[1]).sqrt()
    return [(normals * expected).sum(-1).mean(), relief, 0.5 * (squares[0] / squares[1]).log()]
