"""Settings by which a sequence becomes a rig."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchreg._checks import check_count, check_positive
from torchreg.registration.config import RegisterConfig


@dataclass(frozen=True)
class RigConfig:
    """Settings of `rig_sequence`; lengths are shares of the template's diagonal.

    Args:
        num_bones: most bones where the call gives no number.
        num_points: points to which frames are reduced before they are registered; limbs of one percent keep some.
        cells: of the grid on which weights live, along the longest side.
        rounds: matches of a frame's surface with the rig's, and steps of its pose.
        width: distances at which a match counts less, in the first round and in the last.
        along: weight of a match along the surface, where vertices of different meshes do not correspond.
        stay: how far a turn by one radian from the neighbor in time counts, as a distance.
        alike: a bone whose points its parent moves as near as that, on average, in every frame is part of it.
        doubtful: mean distance from the surface above which a frame is not explained.
        register: of the scan registration that finds bones.

    Raises:
        InputError: if a number is out of range.
    """

    num_bones: int = 32
    num_points: int = 3000
    cells: int = 50
    rounds: int = 16
    width: tuple[float, float] = (0.05, 0.01)
    along: float = 0.1
    stay: float = 0.0006
    alike: float = 0.005
    doubtful: float = 0.025
    register: RegisterConfig = field(default_factory=RegisterConfig)

    def __post_init__(self) -> None:
        for name in ("num_bones", "num_points", "cells", "rounds"):
            check_count(getattr(self, name), name, 1)
        for name, value in (("width", min(self.width)), ("along", self.along), ("doubtful", self.doubtful)):
            check_positive(value, name)
        for name in ("stay", "alike"):
            check_positive(getattr(self, name), name, allow_zero=True)
