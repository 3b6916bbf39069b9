"""Random poses of people: they stand, walk, sit, bend and turn; arms hang, are raised, reach, are crossed or behind."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchreg.geometry.rotation import rotation_between, so3_exp, so3_log
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS

Range = tuple[float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class _ArmHabit:
    """A habit of arms: a left one, of a person who looks along -y with z up.

    The upper arm points about a direction, with a standard deviation of each coordinate; the elbow is bent by an angle,
    degrees; and the forearm leans to a side, if any, else it turns freely.
    """

    share: float
    direction: Vector
    spread: float
    elbow: Range
    side: Vector | None = None


_ARMS = (
    _ArmHabit(0.3, (0.25, 0.0, -1.0), 0.3, (0, 60)),  # hangs
    _ArmHabit(0.3, (0.6, -0.6, 0.0), 0.7, (0, 140)),  # anywhere
    _ArmHabit(0.15, (0.2, -0.1, 1.0), 0.35, (0, 120)),  # raised
    _ArmHabit(0.15, (0.15, -0.7, -0.7), 0.3, (40, 145), (-1.0, -0.3, 0.2)),  # crossed
    _ArmHabit(0.1, (0.25, 0.6, -0.9), 0.25, (10, 120), (-1.0, 0.3, 0.0)),  # behind
)


@dataclass(frozen=True)
class _LegHabit:
    """A habit of legs: degrees of hip flexion, abduction and turn, and of the knee."""

    share: float
    flexion: Range
    abduction: Range
    turn: Range
    knee: Range


_LEGS = (
    _LegHabit(0.45, (-10, 20), (-5, 12), (-15, 15), (0, 25)),  # stands
    _LegHabit(0.2, (-35, 45), (-5, 10), (-15, 15), (0, 70)),  # walks
    _LegHabit(0.2, (65, 110), (-5, 30), (-20, 20), (30, 110)),  # sits
    _LegHabit(0.15, (-25, 115), (-15, 55), (-40, 40), (0, 135)),  # anything
)


@dataclass(frozen=True)
class _Trunk:
    """Angles of trunk, head and base, degrees."""

    every: Range = (2, 14)  # standard deviation of each joint of all, drawn for each person
    alike: float = 0.6  # of the people: both arms, or both legs, have one habit
    bent: float = 0.25  # of the people, who bend forward
    bend: Range = (0, 75)
    spine: Vector = (10, 8, 12)  # standard deviations: forward, sideward, turn
    head: Vector = (20, 12, 25)
    twist: float = 40  # of a forearm that turns freely
    tilt: float = 12  # standard deviation from upright
    leaning: float = 0.15  # of the people, by any angle up to
    lean: float = 60  # a little more than an axis of a frame is off at most


_TRUNK = _Trunk()
_SPINE = ("spine01", "spine02", "spine03", "spine04", "spine05")
_NECK = ("neck01", "neck02", "neck03", "head")
_MIRROR = torch.tensor([-1.0, 1.0, 1.0])


def people_states(body: ArticulatedShape, count: int, generator: torch.Generator) -> Tensor:
    """Return states (count, D + K) of people of random coefficients in random poses, about upright along z.

    Args:
        body: whose parts are named as anny's, their joints with three angles each; it looks along -y at rest.
        count: number of people.
        generator: of all that is random.
    """
    draw, space = _Angles(count, generator, body.rest), body.coefficient_space()
    turns = _joint_turns(body, draw)
    pose = body.rest_pose().repeat(count, 1)
    pose[:, BASE_DOFS:] = _angles_of(turns).flatten(1)
    heading = so3_exp(pad(draw.between((-180, 180)), (2, 0)))
    lean = torch.where(draw.chance(_TRUNK.leaning), draw.between((0, _TRUNK.lean)), draw.normal(1, _TRUNK.tilt))
    axis = normalize(pad(draw.normal(2, 1.0), (0, 1)), dim=-1)
    pose[:, 3:BASE_DOFS] = so3_log(so3_exp(lean * axis) @ heading)
    return torch.cat([pose, space.lower + (space.upper - space.lower) * draw.uniform(len(space))], dim=-1)


@dataclass(frozen=True, eq=False)
class _Angles:
    """Draws angles of people, given in degrees, as radians like a tensor."""

    count: int
    generator: torch.Generator
    like: Tensor

    def uniform(self, number: int) -> Tensor:
        return torch.rand(self.count, number, generator=self.generator, device=self.generator.device).to(self.like)

    def normal(self, number: int, std: float) -> Tensor:
        drawn = torch.randn(self.count, number, generator=self.generator, device=self.generator.device).to(self.like)
        return math.radians(std) * drawn

    def between(self, limits: Range) -> Tensor:
        return math.radians(limits[0]) + math.radians(limits[1] - limits[0]) * self.uniform(1)

    def chance(self, share: float) -> Tensor:
        return self.uniform(1) < share

    def about(self, stds: Vector) -> Tensor:
        return torch.cat([self.normal(1, std) for std in stds], dim=-1)

    def habits(self, shares: list[float]) -> tuple[Tensor, Tensor]:
        """Return the habits (count,) of the left and the right limb."""
        weights = torch.tensor(shares, device=self.generator.device).expand(2, -1)
        left, right = torch.multinomial(weights, self.count, replacement=True, generator=self.generator)
        return left, torch.where(self.chance(_TRUNK.alike)[:, 0], left, right)


def _joint_turns(body: ArticulatedShape, draw: _Angles) -> Tensor:
    """Return how joints turn, (count, J, 3, 3), from rest."""
    joints = [name.removesuffix("_x") for name in body.dof_names[BASE_DOFS::3]]
    number = {name: index for index, name in enumerate(joints)}
    std = draw.between(_TRUNK.every).unsqueeze(-1)
    turns = so3_exp(std * math.degrees(1) * draw.normal(3 * len(joints), 1.0).unflatten(-1, (-1, 3)))
    bend = torch.where(draw.chance(_TRUNK.bent), draw.between(_TRUNK.bend), 0.0)
    major = dict.fromkeys(_SPINE, so3_exp((draw.about(_TRUNK.spine) + pad(bend, (0, 2))) / len(_SPINE)))
    major |= dict.fromkeys(_NECK, so3_exp(draw.about(_TRUNK.head) / len(_NECK)))
    arms = draw.habits([habit.share for habit in _ARMS])
    legs = draw.habits([habit.share for habit in _LEGS])
    mirror = _MIRROR.to(turns).diag()
    for side, arm, leg in zip((".L", ".R"), arms, legs, strict=True):
        left = {**_arm(body, draw, arm), **_leg(draw, leg)}
        major |= {name + side: turn if side == ".L" else mirror @ turn @ mirror for name, turn in left.items()}
    index = [number[name] for name in major]
    turns[:, index] = torch.stack(list(major.values()), dim=1) @ turns[:, index]
    return turns


def _arm(body: ArticulatedShape, draw: _Angles, habit: Tensor) -> dict[str, Tensor]:
    """Return the turns (count, 3, 3) of a left arm's joints by its habit (count,)."""
    rest = dict(zip(body.part_names, body.keypoints(body.rest_pose()).to(draw.like), strict=True))
    upper, lower = (
        normalize(rest[end] - rest[start], dim=0)
        for start, end in (("upperarm01.L", "lowerarm01.L"), ("lowerarm01.L", "wrist.L"))
    )
    hinge = normalize(torch.linalg.cross(upper, lower), dim=0)
    bent = math.acos(float(upper @ lower))
    kinds = [_arm_of(draw, kind, upper, lower) for kind in _ARMS]
    raised, elbow = (
        torch.stack(each)[habit, torch.arange(draw.count, device=habit.device)] for each in zip(*kinds, strict=True)
    )
    return {"upperarm01": raised, "lowerarm01": so3_exp((elbow - bent) * hinge)}


def _arm_of(draw: _Angles, habit: _ArmHabit, upper: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
    """Return the turns (count, 3, 3) of the shoulder, and how the elbow is bent (count, 1), of arms of one habit."""
    spread = habit.spread * math.degrees(1) * draw.normal(3, 1.0)
    direction = normalize(upper.new_tensor(habit.direction) + spread, dim=-1)
    turn = rotation_between(upper.expand_as(direction), direction)
    twist = draw.normal(1, _TRUNK.twist)
    if habit.side is not None:
        # About the upper arm, to where the forearm leans to the side.
        fore = (turn @ lower.unsqueeze(-1)).squeeze(-1)
        wanted = upper.new_tensor(habit.side).expand_as(fore)
        across = torch.linalg.cross(direction, fore)
        angle = torch.atan2(
            (across * wanted).sum(-1, keepdim=True),
            (torch.linalg.cross(across, direction) * wanted).sum(-1, keepdim=True),
        )
        twist = angle + 0.5 * twist
    return so3_exp(twist * direction) @ turn, draw.between(habit.elbow)


def _leg(draw: _Angles, habit: Tensor) -> dict[str, Tensor]:
    """Return the turns (count, 3, 3) of a left leg's joints by its habit (count,)."""
    kinds = [
        torch.cat([draw.between(limits) for limits in (kind.flexion, kind.abduction, kind.turn, kind.knee)], dim=-1)
        for kind in _LEGS
    ]
    flexion, abduction, turn, knee = torch.stack(kinds)[habit, torch.arange(draw.count, device=habit.device)].split(
        1, dim=-1
    )
    hip = so3_exp(pad(-abduction, (1, 1))) @ so3_exp(pad(-flexion, (0, 2))) @ so3_exp(pad(turn, (2, 0)))
    return {"upperleg01": hip, "lowerleg01": so3_exp(pad(knee, (0, 2)))}


def _angles_of(turns: Tensor) -> Tensor:
    """Return angles (..., 3) about x, y and z of rotations (..., 3, 3), the last of which comes first."""
    about_y = turns[..., 0, 2].clamp(-1, 1).asin()
    about_x = torch.atan2(-turns[..., 1, 2], turns[..., 2, 2])
    return torch.stack([about_x, about_y, torch.atan2(-turns[..., 0, 1], turns[..., 0, 0])], dim=-1)
