"""Range scans of moving figures with exact truth, such as a toy whose joints turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.datasets.depth_scanner import DepthScanner, SurfaceScan
from torchreg.datasets.figures import Figure
from torchreg.datasets.toys import Toy, robot
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import View, visible_points


@dataclass(frozen=True)
class _CameraSetup:
    """The camera before a figure."""

    distance: float = 1.7  # in diagonals of the figure's rest pose
    reach: float = 0.45  # tangent of half the angle of view: a figure that fills a ball of its diagonal stays inside


_CAMERA = _CameraSetup()


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two range scans of a figure in two poses, and the truth."""

    source: RangeScan
    target: RangeScan
    truth: Tensor  # (N, 3) true positions of the source's points in the target's pose, noiseless, visible or not
    labels: Tensor  # (N,) int64 true part of each source point
    target_labels: Tensor
    joints: Tensor  # (J, 3) true joints in the source's pose, of each part but the root with its parent
    target_joints: Tensor
    joint_parts: Tensor  # (J, 2) parts that meet at each joint, the parent first
    transforms: Tensor  # (P, 4, 4) true motions of the parts from source to target
    part_names: tuple[str, ...]
    visible: Tensor  # (N,) bool, True where the target's camera sees the true position
    missing: Tensor  # (N,) bool, True on parts that were taken off before the target was scanned

    def error(self, deformed: Tensor) -> Tensor:
        """Return distances (N,) of moved source points (N, 3) from the truth, as shares of the source's diagonal."""
        return (deformed - self.truth.to(deformed)).norm(dim=-1) / self.source.diagonal


@dataclass(frozen=True, eq=False)
class ScanSequence(Sequence[RangeScan]):
    """Frames of a moving figure, each scanned from one side on request, always with the same result.

    ``sequence[t]`` is a `RangeScan` and ``sequence.pair(s, t)`` a `ScanPair`.
    """

    figure: Figure
    transforms: Tensor  # (T, P, 4, 4) float64 motions of the parts from the rest pose to before the camera
    scanner: DepthScanner = field(default_factory=DepthScanner)
    missing: tuple[int, ...] = ()  # the part that was taken off in each frame, -1 for none; empty where none ever is
    seed: int = 0
    dtype: torch.dtype = torch.float32

    def __post_init__(self) -> None:
        if len(self.missing) not in (0, len(self)):
            raise InputError(f"missing must have one number per frame ({len(self)}), got {len(self.missing)}")

    @cached_property
    def view(self) -> View:
        """The camera, whose pixels are chosen by the first frame."""
        return self.scanner.view(self.mesh(0), _CAMERA.reach)

    def __len__(self) -> int:
        return len(self.transforms)

    def __getitem__(self, frame: int) -> RangeScan:  # type: ignore[override]
        return self.scanned(frame).scan

    def mesh(self, frame: int) -> TriangleMesh:
        """Return the complete surface in a frame, float64, with the parts that are missing."""
        return TriangleMesh(self.figure.vertices(self.transforms[frame]), self.figure.mesh.faces)

    def scanned(self, frame: int) -> SurfaceScan:
        """Return the scan of a frame, with the positions of its points on the mesh."""
        frame = range(len(self))[frame]
        # Unlike generators of neighboring seeds, all draws of one generator are independent.
        seeds = torch.randint(2**62, (len(self),), generator=torch.Generator().manual_seed(self.seed))
        generator = torch.Generator().manual_seed(int(seeds[frame]))
        present = self._present(frame).nonzero()[:, 0]
        mesh = self.mesh(frame)
        found = self.scanner.scan(TriangleMesh(mesh.vertices, mesh.faces[present]), self.view, generator, self.dtype)
        return SurfaceScan(found.scan, present[found.face], found.barycentric)

    def pair(self, source: int, target: int) -> ScanPair:
        """Return two frames with the truth."""
        return self._pair(source, target, self.scanned(source), self.scanned(target))

    def pairs(self, step: int = 1) -> Iterator[ScanPair]:
        """Yield the pairs of frames ``step`` apart, T - step of them; each frame is scanned once."""
        check_count(step, "step", 1)
        scans = [self.scanned(frame) for frame in range(min(step, len(self)))]
        for target in range(step, len(self)):
            scans.append(self.scanned(target))
            yield self._pair(target - step, target, scans.pop(0), scans[-1])

    def truth(self, source: int, target: int) -> Tensor:
        """Return the true positions (N, 3) of a frame's scanned points in the pose of another frame."""
        return self._positions(self.scanned(source), target)

    def labels(self, frame: int) -> Tensor:
        """Return the true parts (N,) of the scanned points of a frame."""
        return self._labels(self.scanned(frame))

    @property
    def joint_parts(self) -> Tensor:
        """(P - 1, 2) parts that meet at the joints, the parent first."""
        children = torch.arange(1, self.figure.num_parts)
        return torch.stack((torch.tensor(self.figure.parents[1:], dtype=torch.int64), children), dim=-1)

    def joints(self, frame: int) -> Tensor:
        """Return the joints (P - 1, 3) in a frame, in the order of the child parts."""
        return self.figure.joint_positions(self.transforms[frame]).to(self.dtype)

    def _pair(self, source: int, target: int, source_scan: SurfaceScan, target_scan: SurfaceScan) -> ScanPair:
        source, target = range(len(self))[source], range(len(self))[target]
        truth, mesh, present = self._positions(source_scan, target), self.mesh(target), self._present(target)
        visible = visible_points(TriangleMesh(mesh.vertices, mesh.faces[present]), truth, torch.zeros(3))
        missing = ~present[source_scan.face]
        motions = self.transforms[target] @ invert_rigid(self.transforms[source])
        return ScanPair(
            source=source_scan.scan,
            target=target_scan.scan,
            truth=truth,
            labels=self._labels(source_scan),
            target_labels=self._labels(target_scan),
            joints=self.joints(source),
            target_joints=self.joints(target),
            joint_parts=self.joint_parts,
            transforms=motions.to(self.dtype),
            part_names=self.figure.part_names,
            visible=visible & ~missing,
            missing=missing,
        )

    def _positions(self, found: SurfaceScan, frame: int) -> Tensor:
        """Return the true positions (N, 3) of scanned points in the pose of a frame."""
        mesh = self.mesh(frame)
        return found.transferred(mesh.vertices, mesh.faces).to(self.dtype)

    def _labels(self, found: SurfaceScan) -> Tensor:
        return found.transferred(self.figure.weights, self.figure.mesh.faces).argmax(-1)

    def _present(self, frame: int) -> Tensor:
        """Return the mask (F,) of the figure's faces on parts that were not taken off."""
        missing = self.missing[frame] if self.missing else -1
        return (self.figure.weights.argmax(-1) != missing)[self.figure.mesh.faces].any(-1)


def jointed_toy(
    frames: int = 40,
    seed: int = 0,
    *,
    toy: Toy | None = None,
    step: float = math.radians(30),
    turn: float = math.radians(10),
    missing: bool = False,
    scanner: DepthScanner | None = None,
    dtype: torch.dtype = torch.float32,
) -> ScanSequence:
    """Return scans of a toy whose joints are turned at random from frame to frame before a depth camera.

    Between adjacent frames joints turn by at most ``step`` and the toy about its vertical by at most ``turn``, radians;
    it is also tilted by up to 30 degrees. With ``missing`` a part without children, drawn anew each time, is taken off
    in every second frame (Chang and Zwicker 2009, figure 9).
    """
    check_count(frames, "frames", 2)
    check_positive(turn, "turn", allow_zero=True)
    toy = robot() if toy is None else toy
    generator = torch.Generator().manual_seed(seed)
    angles = toy.random_motion(frames, step, generator)
    figure = toy.figure
    draws = torch.rand(frames, generator=generator, dtype=torch.float64)
    change = turn * (2 * draws - 1)
    change[0] = 2 * math.pi * draws[0]
    tilt = math.radians(30) * (2 * torch.rand(1, generator=generator, dtype=torch.float64) - 1)
    ends = [part for part in range(1, figure.num_parts) if part not in figure.parents]
    drawn = torch.randint(len(ends), (frames,), generator=generator).tolist()
    absent = tuple(ends[number] if missing and frame % 2 else -1 for frame, number in enumerate(drawn))
    base = facing_camera(figure, change.cumsum(0), tilt.expand(frames), torch.zeros_like(change))
    transforms = figure.transforms(toy.rotations(angles), base)
    return ScanSequence(figure, transforms, scanner or DepthScanner(), absent, seed, dtype)


def facing_camera(figure: Figure, angle: Tensor, tilt: Tensor, heights: Tensor) -> Tensor:
    """Return motions (T, 4, 4) of a figure to before the camera, from angles, tilts (radians) and heights (T,)."""
    zero = torch.zeros_like(angle)
    lower, upper = figure.mesh.bounds()
    middle = (lower + upper) / 2
    # From y up and z forward to a camera that looks along +z with -y up: half a turn about x.
    facing = so3_exp(torch.stack((math.pi + tilt, zero, zero), dim=-1)) @ so3_exp(
        torch.stack((zero, angle, zero), dim=-1)
    )
    risen = torch.stack((zero, heights, zero), dim=-1) - middle
    position = middle.new_tensor([0.0, 0.0, _CAMERA.distance * float((upper - lower).norm())])
    return rigid_matrix(facing, (facing @ risen.unsqueeze(-1)).squeeze(-1) + position)
