"""A network that proposes people: from clouds of a body to places of its surface, and states from these."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchreg.alignment.fit.objectives import GaussianPosePrior, registration_objective
from torchreg.alignment.fit.problem import joint_precision
from torchreg.alignment.search.multi_start import distinct_first
from torchreg.alignment.search.pose_proposer import CloudNet, ProposerSize
from torchreg.alignment.search.rough_poses import closeness, two_sided_cost
from torchreg.alignment.shape.shape_problem import ShapeProblem
from torchreg.errors import FormatError
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import rotation_between, so3_exp, so3_log
from torchreg.geometry.rotation_representations import rotation_from_6d, rotation_to_6d
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.upright import Direction
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.shaped import ShapedSkin, ShapedTree
from torchreg.shapes.spec import RigSurface
from torchreg.solvers.e_step import EStep

_KIND = "PersonProposer"
# Of anny's body, if it comes with this torchreg.
BODY_WEIGHTS = Path(__file__).with_name("people.safetensors")


@dataclass(frozen=True)
class _Marks:
    """Vertices of the body whose places the network tells."""

    groups: int = 16  # that cover the body, whose vertices are told by the same tokens
    each: int = 8  # vertices of a group


@dataclass(frozen=True)
class _States:
    """How people are taken from proposed places; lengths are shares of the size."""

    num_data: int = 500  # by which proposals are ranked
    same: float = 0.05  # proposals whose marks differ by less are one
    error: float = 0.02  # of a mark
    joint_std: float = 0.35  # of a joint about rest, radians: marks tell of a limb, not of each of its joints
    steps: int = 12  # from rest to any pose


_MARKS, _STATES = _Marks(), _States()
PERSON_SIZE = ProposerSize(tokens=96, encoder=3, hypotheses=4)


class RawPeople(NamedTuple):
    """Places of the marks (B, K, P, 3), metres, and logits (B, K); surface and token_index as of `RawPoses`."""

    marks: Tensor
    logits: Tensor
    surface: Tensor
    token_index: Tensor


class PersonProposer(CloudNet):
    """Proposes where marks on a body's surface lie, for people of any size and pose who stand about along z.

    Every token tells how far the marks are from it, in the frame of a hypothesis, and how much that counts for each
    group of marks. Places rather than angles: they are linear in what is seen, and of all sizes alike.

    Args:
        size: see `ProposerSize`.
        shape_size: of the mean person, metres.
        marks: (P,) numbers of vertices, as `spread_marks` gives them.
        at_rest: (P, 3) where they lie on the mean person, shares of the size.
        up: direction (3,) that is upright there.
        num_vertices: of the body.

    Shape of ``forward(points, mask)``: as of `PoseProposer`; see `RawPeople`.

    Differentiable: in its parameters and the points.

    References: Qi et al. 2019 (VoteNet), for votes; Carion et al. 2020, for hypotheses.
    """

    marks: Tensor
    at_rest: Tensor
    headings: Tensor

    def __init__(
        self, size: ProposerSize, shape_size: float, marks: Tensor, at_rest: Tensor, up: Direction, num_vertices: int
    ) -> None:
        super().__init__(size, shape_size)
        self.num_vertices, width, self.up = num_vertices, size.width, up
        # Each hypothesis begins with another heading: front and back look much alike, and their mean like neither.
        angles = torch.arange(size.hypotheses) * (math.tau / size.hypotheses)
        headings = rotation_to_6d(so3_exp(angles.unsqueeze(-1) * torch.tensor(up))).float()
        for name, value in {"marks": marks, "at_rest": at_rest, "headings": headings}.items():
            self.register_buffer(name, value, persistent=False)
        self.told = nn.Linear(width, 7)
        self.condition = nn.Linear(width, width)
        last = nn.Linear(width, (3 * _MARKS.each + 1) * _MARKS.groups)
        self.vote = nn.Sequential(nn.GELU(), nn.Linear(width, width), nn.GELU(), last)
        self.surface = nn.Linear(width, 4)
        with torch.no_grad():
            for layer in (last, self.told):
                layer.weight.mul_(0.1)
                layer.bias.zero_()

    @classmethod
    def of(cls, body: ArticulatedShape, size: ProposerSize | None = None) -> PersonProposer:
        """Return a network for a body with coefficients, in metres, untrained."""
        space = body.coefficient_space()
        at_mean = space.rest(space.mean)[0].detach().float()
        extent, marks = float((at_mean.amax(0) - at_mean.amin(0)).norm()), spread_marks(at_mean)
        at_rest = (at_mean[marks] - at_mean[marks].mean(0)) / extent
        return cls(size or PERSON_SIZE, extent, marks, at_rest, body.up, len(at_mean)).to(at_mean.device)

    def forward(self, points: Tensor, mask: Tensor) -> RawPeople:
        """Return places, see the class."""
        found = self.attended(points, mask, self.queries)
        turn, logits = self.told(found.state).float().split((6, 1), dim=-1)
        rotation = rotation_from_6d(turn + self.headings)
        out = self.vote(found.tokens.unsqueeze(1) + self.condition(found.state).unsqueeze(2)).float()
        known = mask.gather(1, found.token_index)[:, None, :, None]
        offset, weight = out.split((3 * len(self.marks), _MARKS.groups), dim=-1)
        weight = weight.masked_fill(~known, -torch.inf).softmax(2).nan_to_num()
        mean = torch.einsum("bktg,bktgc->bkgc", weight, offset.unflatten(-1, (_MARKS.groups, -1)))
        mean = mean.unflatten(-1, (-1, 3)).flatten(2, 3) + self.at_rest
        places = points.gather(1, found.token_index.unsqueeze(-1).expand(-1, -1, 3))
        base = torch.einsum("bktg,btc->bkgc", weight, places).repeat_interleave(_MARKS.each, 2)
        return RawPeople(
            marks=base + self.shape_size * mean @ rotation.mT,
            logits=logits.squeeze(-1),
            surface=self.surface(found.tokens).float(),
            token_index=found.token_index,
        )

    @torch.no_grad()
    def propose(
        self, problem: ShapeProblem, surface: RigSurface, count: int, generator: torch.Generator,
        upright: Direction | None = None,
    ) -> Tensor:  # fmt: skip
        """Return states (count, D + K) of different people in the one scan of a problem, best first.

        They may stand along any axis of the data's coordinates, or along ``upright`` alone.

        Args:
            problem: of one row, with the body's tree.
            surface: of the body.
            count: of the states.
            generator: by which data are drawn.
            upright: direction (3,) that is upright in the data, if that is known.
        """
        turns = _turns(problem.skin.shape.rig.up, upright).to(problem.data)
        clouds = problem.data @ turns.mT
        points, mask = self.fitting(clouds, problem.valid.expand(len(turns), -1))
        raw = self(points.to(self.queries), mask)
        marks = raw.marks.to(clouds) @ turns.unsqueeze(1)
        every = marks.flatten(0, 1).unsqueeze(0)
        drawn = problem.draw(_STATES.num_data, generator)
        cost = two_sided_cost(*closeness(every, drawn, problem.size), drawn)[0]
        ranked = every[0, cost.argsort()]
        apart = (ranked.unsqueeze(1) - ranked).norm(dim=-1).mean(-1)
        different = distinct_first((apart < _STATES.same * problem.size).unsqueeze(0))[0, :count]
        return self._states(problem, surface, ranked[different])

    def _states(self, problem: ShapeProblem, surface: RigSurface, marks: Tensor) -> Tensor:
        """Return the states (B, D + K) in which the body's marks lie at places (B, P, 3)."""
        tree = problem.skin.shape
        rig, space = tree.rig, tree.space
        skin, mean = _mark_skin(tree, surface, self.marks), torch.cat([rig.rest, space.mean]).repeat(len(marks), 1)
        one = torch.ones_like(marks[..., 0])
        motion = fit_rigid(skin.points.expand_as(marks), marks, one)
        mean[:, :3] = transform_points(motion, mean[:, None, :3])[:, 0]
        mean[:, 3:BASE_DOFS] = so3_log(motion[:, :3, :3])
        precision = torch.cat([joint_precision(rig, problem.size, _STATES.joint_std), space.std.square().reciprocal()])
        matches = EStep(one, marks, one.sum(1), torch.zeros_like(one[:, 0]))
        sigma = torch.full_like(mean[:, 0], _STATES.error * problem.size)
        prior = GaussianPosePrior(mean, precision)
        objective = registration_objective(skin, matches, sigma, prior)  # type: ignore[arg-type]
        state, rows = mean, problem.rows(torch.zeros(len(marks), dtype=torch.int64))
        for _ in range(_STATES.steps):
            state = rows.step(objective(state), state).state
        return state

    def save(self, path: str | os.PathLike[str], training: Mapping[str, Any] | None = None) -> None:
        """Write the weights in half precision as safetensors, and beside them JSON that tells for which body.

        Args:
            path: to be written, ``.safetensors``.
            training: what to remember of the training.
        """
        record = {
            "kind": _KIND, "shape_size": self.shape_size, "up": list(self.up), "num_vertices": self.num_vertices,
            "marks": self.marks.tolist(), "sizes": asdict(self.size), "training": dict(training or {}),
        }  # fmt: skip
        state = {**self.state_dict(), "at_rest": self.at_rest}
        save_tensors(path, {name: value.half() for name, value in state.items()}, record)

    @staticmethod
    def load(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> PersonProposer:
        """Return the network of a file.

        Raises:
            FileNotFoundError: if there is no such file.
            FormatError: if the file is damaged, or holds no such network.
        """
        tensors, record = load_tensors(path, limits=limits)
        if record.get("kind") != _KIND:
            raise FormatError(f"{path}: holds no {_KIND}, got {record.get('kind')!r}")
        state = {name: value.float() for name, value in tensors.items()}
        try:
            # Layers draw weights before those of the file replace them: the caller's random state stays.
            with torch.random.fork_rng(devices=[]):
                found = PersonProposer(
                    ProposerSize(**record["sizes"]), record["shape_size"], torch.tensor(record["marks"]),
                    state.pop("at_rest"), tuple(record["up"]), record["num_vertices"],
                )  # fmt: skip
            found.load_state_dict(state)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise FormatError(f"{path}: holds no {_KIND} of this version ({error})") from error
        return found.requires_grad_(False).eval()


def spread_marks(points: Tensor) -> Tensor:
    """Return the numbers of vertices (V, 3) that cover a body, group after group."""
    centers = points[farthest_points(points, _MARKS.groups)]
    cell = torch.cdist(points, centers).argmin(-1)
    cells = [(cell == number).nonzero()[:, 0] for number in range(_MARKS.groups)]
    return torch.cat([index[farthest_points(points[index], _MARKS.each)] for index in cells])


def is_body(shape: ArticulatedShape) -> bool:
    """Whether a shape is a body of anny's: with coefficients, and with its joints."""
    return shape.space is not None and {"upperarm01.L", "lowerleg01.R", "spine05"} <= set(shape.part_names)


@lru_cache(maxsize=1)
def _read(path: Path, _changed: int, device: torch.device) -> PersonProposer:
    # What is made in inference mode could not be used outside of it.
    with torch.inference_mode(False):
        return PersonProposer.load(path).to(device)


def shipped_people(body: ArticulatedShape) -> PersonProposer | None:
    """Return the network that comes with torchreg for a body of anny's, read once; None for other shapes."""
    if not is_body(body) or not BODY_WEIGHTS.exists():
        return None
    found = _read(BODY_WEIGHTS, BODY_WEIGHTS.stat().st_mtime_ns, body.rest.device)
    return found if found.num_vertices == len(body.file_surface().vertices) else None


def _turns(own: Direction, upright: Direction | None) -> Tensor:
    """Return rotations (U, 3, 3) that take what is upright in data to the upright of the body."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    ups = axes if upright is None else torch.tensor([upright], dtype=torch.float64)
    return rotation_between(torch.nn.functional.normalize(ups, dim=-1), torch.tensor(own, dtype=torch.float64))


def _mark_skin(tree: ShapedTree, surface: RigSurface, marks: Tensor) -> ShapedSkin:
    """Return the skin of some vertices (P,), each the first corner of a face."""
    first = (surface.faces == marks[:, None, None]).flatten(1).int().argmax(-1)
    corners = surface.faces.repeat_interleave(3, 0)[first]
    shares = torch.nn.functional.one_hot(first % 3, 3).to(tree.rest)
    return ShapedSkin(tree, corners, shares, surface.weights[marks].to(tree.rest))
