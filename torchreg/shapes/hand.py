"""A human hand: 16 ellipsoid parts, 27 degrees of freedom, adult proportions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_positive
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive

FINGER_NAMES = ("thumb", "index", "middle", "ring", "little")
_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class _Finger:
    """Proportions of a finger of a right hand at rest; x: thumb side, y: back, z: to the tips.

    Joints have motions and their limits in degrees; ``overlap`` lengthens inner ellipsoids, so that they fuse smoothly.
    """

    base_mm: _Vector
    lengths_mm: _Vector
    radii_mm: _Vector
    direction: _Vector
    dorsal: _Vector = (0.0, 1.0, 0.0)
    segments: tuple[str, str, str] = ("proximal", "middle", "distal")
    joints: tuple[tuple[str, tuple[tuple[str, float, float], ...]], ...] = (
        ("mcp", (("abduction", -20.0, 20.0), ("flexion", -20.0, 95.0))),
        ("pip", (("flexion", -5.0, 110.0),)),
        ("dip", (("flexion", -5.0, 85.0),)),
    )
    overlap: float = 1.12

    @classmethod
    def long(cls, base_mm: _Vector, spread_deg: float, lengths_mm: _Vector, radii_mm: _Vector) -> _Finger:
        """Return a finger other than the thumb, spread to the thumb side by an angle."""
        spread = math.radians(spread_deg)
        return cls(base_mm, lengths_mm, radii_mm, (math.sin(spread), 0.0, math.cos(spread)))


@dataclass(frozen=True)
class _Palm:
    """The palm's ellipsoid in a right hand, in the axes of `_Finger`."""

    center_mm: _Vector = (-3.0, 0.0, 47.0)
    radii_mm: _Vector = (44.0, 15.0, 56.0)


_PALM = _Palm()
_FINGERS = {
    "thumb": _Finger(
        base_mm=(22.0, -8.0, 20.0),
        lengths_mm=(46.0, 34.0, 29.0),
        radii_mm=(13.0, 10.5, 9.5),
        direction=(0.66, -0.36, 0.66),
        dorsal=(0.68, 0.60, -0.42),
        segments=("metacarpal", "proximal", "distal"),
        joints=(
            ("cmc", (("abduction", -35.0, 35.0), ("flexion", -30.0, 45.0))),
            ("mcp", (("abduction", -15.0, 15.0), ("flexion", -15.0, 65.0))),
            ("ip", (("flexion", -20.0, 85.0),)),
        ),
    ),
    "index": _Finger.long((26.0, 3.0, 91.0), 4.0, (44.0, 26.0, 23.0), (9.5, 8.5, 7.5)),
    "middle": _Finger.long((4.0, 5.0, 94.0), 0.0, (48.0, 31.0, 24.0), (9.8, 8.7, 7.8)),
    "ring": _Finger.long((-16.0, 3.0, 87.0), -4.0, (44.0, 29.0, 24.0), (9.3, 8.2, 7.4)),
    "little": _Finger.long((-34.0, -1.0, 78.0), -9.0, (35.0, 21.0, 21.0), (8.3, 7.3, 6.5)),
}


class Hand(ArticulatedShape):
    """A hand with 16 parts and 27 degrees of freedom: 6 of the palm, thumb 2 + 2 + 1, fingers 2 + 1 + 1.

    At the zero pose the wrist is at the origin, the fingers point along +z, the back of the hand faces +y and the thumb
    of a right hand lies on +x. Positive flexion closes the hand, positive abduction moves towards the thumb side.

    The logarithms of scales, one per part, give `bone_lengths` and `radii`; see `ArticulatedShape` for all parameters.

    Args:
        side: "right" or "left".
        scale: overall size; 1 is an adult hand, 0.197 m from the wrist to the tip of the middle finger.
        nu: fusion length, metres.
        sharpness: of the bending skin, a in eq. 3.
        dtype: of all parameters and buffers; the default dtype if None.

    Raises:
        InputError: if ``side`` is unknown, or ``scale``, ``nu`` or ``sharpness`` not positive.

    References: Dewaele et al. 2006, section 2.
    """

    def __init__(
        self,
        side: str = "right",
        *,
        scale: float = 1.0,
        nu: float = 0.003,
        sharpness: float = 2.0,
        dtype: torch.dtype | None = None,
    ) -> None:
        check_choice(side, "side", ("right", "left"))
        check_positive(scale, "scale")
        self.side, self.scale = side, float(scale)
        unit = 1e-3 * scale
        mirror = 1.0 if side == "right" else -1.0
        joints, part_frames = [Joint("palm", -1, torch.eye(4, dtype=torch.float64))], ["palm"]
        palm_pose = _translation(_PALM.center_mm, unit, mirror)
        primitives = [Primitive("ellipsoid", tuple(radius * unit for radius in _PALM.radii_mm), palm_pose)]
        bones = [math.hypot(*_FINGERS["middle"].base_mm) * unit]
        for name, finger in _FINGERS.items():
            _add_finger(joints, part_frames, name, finger, unit, mirror)
            primitives += _phalanx_primitives(finger, unit)
            bones += [length * unit for length in finger.lengths_mm]
        part_names = ["palm"] + [f"{name}_{segment}" for name, f in _FINGERS.items() for segment in f.segments]
        super().__init__(
            KinematicTree(tuple(joints)), part_frames, primitives,
            nu=nu, sharpness=sharpness, part_names=part_names, dtype=dtype,
        )  # fmt: skip
        self.register_buffer("_bones", torch.tensor(bones, dtype=self.rest.dtype), persistent=False)

    _bones: Tensor

    @property
    def bone_lengths(self) -> Tensor:
        """Length (16,) of each part's bone, metres: of the palm from wrist to middle finger, of a phalanx to its end.

        Differentiable: in `log_length_scales`.
        """
        return self._bones * self.log_length_scales.exp()

    @property
    def radii(self) -> Tensor:
        """Radii (16, 3) of each part's ellipsoid along its x, y and z (the bone's) axis, metres.

        Differentiable: in `log_length_scales` and `log_radius_scales`.
        """
        return self._scaled_sizes()[0]

    @property
    def fingertip_parts(self) -> tuple[int, ...]:
        """Indices of the five distal phalanges, thumb to little finger."""
        return tuple(3 * finger + 3 for finger in range(5))

    @property
    def length(self) -> float:
        """Distance from the wrist to the farthest fingertip at rest, metres."""
        with torch.no_grad():
            points = self.keypoints(self.rest_pose())
        return float((points - points[0]).norm(dim=-1).max())

    def placed_keypoints(self, transforms: Tensor) -> Tensor:
        """Return 21 keypoints: wrist, then thumb to little finger, each from its base joint to its tip.

        Args:
            transforms: (..., 16, 4, 4) ``T_world_part``.

        Returns:
            (..., 21, 3), metres, as `keypoints`.

        Differentiable: in ``transforms`` and the bone lengths.
        """
        origins = transforms[..., :3, 3]
        distal = list(self.fingertip_parts)
        tips = origins[..., distal, :] + transforms[..., distal, :3, 2] * self.bone_lengths[distal].unsqueeze(-1)
        fingers = torch.cat([origins[..., 1:, :].unflatten(-2, (5, 3)), tips.unsqueeze(-2)], dim=-2)
        return torch.cat([origins[..., :1, :], fingers.flatten(-3, -2)], dim=-2)


def _translation(offset_mm: _Vector, unit: float, mirror: float) -> Tensor:
    """Return the translation (4, 4), mirrored for a left hand; a millimeter is ``unit`` metres."""
    offset = torch.tensor(offset_mm, dtype=torch.float64) * unit * torch.tensor([mirror, 1.0, 1.0], dtype=torch.float64)
    return rigid_matrix(torch.eye(3, dtype=torch.float64), offset)


def _finger_rotation(finger: _Finger, mirror: float) -> Tensor:
    """Return the finger's frame: z along it, y towards its back, mirrored for a left hand."""
    z = torch.tensor(finger.direction, dtype=torch.float64)
    z = z / z.norm()
    y = torch.tensor(finger.dorsal, dtype=torch.float64)
    y = y - (y @ z) * z
    y = y / y.norm()
    rotation = torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
    flip = torch.diag(torch.tensor([mirror, 1.0, 1.0], dtype=torch.float64))
    return flip @ rotation @ flip


def _add_finger(
    joints: list[Joint], part_frames: list[str], name: str, finger: _Finger, unit: float, mirror: float
) -> None:
    parent = 0
    offset = _translation(finger.base_mm, unit, mirror)
    offset[:3, :3] = _finger_rotation(finger, mirror)
    for (joint_name, motions), length in zip(finger.joints, finger.lengths_mm, strict=True):
        for motion, lower, upper in motions:
            joints.append(
                Joint(
                    name=f"{name}_{joint_name}_{motion}",
                    parent=parent,
                    offset=offset,
                    kind="revolute",
                    axis=(1.0, 0.0, 0.0) if motion == "flexion" else (0.0, mirror, 0.0),
                    lower=math.radians(lower),
                    upper=math.radians(upper),
                )
            )
            parent, offset = len(joints) - 1, torch.eye(4, dtype=torch.float64)
        part_frames.append(joints[-1].name)
        offset = _translation((0.0, 0.0, length), unit, 1.0)


def _phalanx_primitives(finger: _Finger, unit: float) -> list[Primitive]:
    primitives = []
    for index, (length, radius) in enumerate(zip(finger.lengths_mm, finger.radii_mm, strict=True)):
        half = 0.5 * length * (finger.overlap if index < 2 else 1.0)
        center = _translation((0.0, 0.0, 0.5 * length), unit, 1.0)
        primitives.append(Primitive("ellipsoid", (radius * unit, radius * unit, half * unit), center))
    return primitives
