"""Settings of scan registration: of the dense alignment and of the bones fitted to it."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchreg.registration.bones.config import BoneConfig
from torchreg.registration.dense.config import ScanAlignConfig


@dataclass(frozen=True)
class RegisterConfig(BoneConfig):
    """Settings by which a reduced deformable model is fitted to two scans or more.

    Args:
        align: the dense alignment from which parts are found; all others as in `BoneConfig`.

    Raises:
        InputError: if a value is out of range.
    """

    align: ScanAlignConfig = field(default_factory=ScanAlignConfig)
