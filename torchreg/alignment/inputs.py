"""What an alignment is asked for, and its checks at the public functions: clouds and masks, skins, starts, units."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchreg._checks import as_float_tensor, check_choice, check_shape
from torchreg.alignment.fit.landmarks import MeasuredKeypoints, keypoint_extent
from torchreg.alignment.fit.problem import model_size
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.free_space import FreeSpace
from torchreg.errors import DegenerateDataWarning, InputError, InputTypeError, UnitsWarning
from torchreg.geometry.camera import Camera
from torchreg.geometry.far_origin import far_origin, to_local, to_world
from torchreg.geometry.loaded import as_points
from torchreg.geometry.sampling import draw_spread
from torchreg.geometry.spread import SAME_SHARE, SPREADS, spread_dimensions
from torchreg.geometry.support import SUPPORTS, split_support, warn_about_support
from torchreg.geometry.units import LENGTHS, likely_unit
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin, sample_skin

if TYPE_CHECKING:
    from torchreg.alignment.config import AlignConfig
    from torchreg.alignment.fit.annealed_em import OnStep
    from torchreg.alignment.known_dofs import KnownDofs
    from torchreg.alignment.search.start_source import StartSource
    from torchreg.alignment.shape.person_proposer import PersonProposer


@dataclass(frozen=True)
class UnitsCheck:
    """Thresholds of data and shape in different units."""

    ratio: float = 30.0  # of their sizes: no pose and no crop explains more
    min_data: int = 10  # with a reliable size


@dataclass(frozen=True)
class _Fitted:
    """How many data of a large cloud poses are fitted to."""

    most: int = 10_000  # of a cloud: more move a pose by far less than models are exact
    searched: int = 4000  # of those, by candidates of a search, of which one is fitted again
    size_points: int = 200  # of a skin that tells the shape's size
    support_points: int = 2000  # of a skin that says whether the shape has a flat foot of its own


UNITS = UnitsCheck()
_FITTED = _Fitted()


@dataclass(frozen=True, eq=False)
class Observation:
    """What a shape is aligned to: points ((B,) M, 3), metres, unchecked, or those of depth frames, and keypoints.

    `origin` (3,) is where the points begin; `everything` are checked clouds and valid points of which these are a draw;
    keypoints alone have no points, but those in pixels a `camera`.
    """

    points: Any
    mask: Tensor | None
    free_space: FreeSpace | None = None
    frames: tuple[DepthFrame, ...] = ()
    keypoints: MeasuredKeypoints | None = None
    origin: Tensor | None = None
    everything: tuple[Tensor, Tensor] | None = None
    camera: Camera | None = None

    @classmethod
    def of(cls, data: Any, mask: Tensor | None) -> Observation:
        """Return the observation of points, something with points, depth frames, or the camera of keypoints alone."""
        if data is None or isinstance(data, Camera):
            return cls(None, None, camera=data)
        several = isinstance(data, Sequence) and any(isinstance(item, DepthFrame) for item in data)
        frames = list(data) if several else [data]
        if not isinstance(frames[0], DepthFrame) and not several:
            return cls(as_points(data), mask)
        if mask is not None:
            raise InputError("mask goes with clouds; a depth frame has its own: DepthFrame(depth, camera, mask)")
        for number, frame in enumerate(frames):
            if not isinstance(frame, DepthFrame):
                raise InputTypeError(f"data[{number}] must be a DepthFrame like the others, got {type(frame).__name__}")
        clouds, space = [frame.points for frame in frames], FreeSpace.stacked([frame.free_space for frame in frames])
        if not several:
            return cls(clouds[0], None, space, tuple(frames))
        return cls(*_padded(clouds), space, tuple(frames))

    def without_support(self, shape: ArticulatedShape, support: str) -> Observation:
        """Return the same without the table or floor that a scanned thing stands on, unless the shape has a flat foot.

        Whatever is wrong with the points is reported where they are checked.
        """
        check_choice(support, "support", SUPPORTS)
        left = support == "keep" or self.frames or self.points is None
        points = None if left else as_float_tensor(self.points, "data")
        if points is None or points.ndim not in (2, 3) or points.shape[-1] != 3 or points.numel() == 0:
            return self
        mask, valid = self.mask, points.isfinite().all(-1)
        if mask is not None:
            if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != valid.shape:
                return self
            valid = valid & mask.to(valid.device)
        kept = valid.clone()
        clouds = points.detach().reshape(-1, *points.shape[-2:])
        for cloud, rest in zip(clouds, kept.view(-1, kept.shape[-1]), strict=True):
            if bool(rest.any()):
                rest[rest.clone()] = ~split_support(cloud[rest]).mask
        on_support = int(valid.sum() - kept.sum())
        if on_support == 0 or split_support(sample_skin(shape, _FITTED.support_points).points).plane is not None:
            return self
        # From the caller of `align`.
        warn_about_support(f"{on_support} of {int(valid.sum())} points of data", stacklevel=5)
        return replace(self, mask=kept if self.mask is None else kept & self.mask.to(kept.device))

    def near(self, origin: Tensor) -> Observation:
        """Return the same in coordinates that begin at an origin (3,)."""
        space = None if self.free_space is None else self.free_space.moved(origin)
        keypoints = None if self.keypoints is None else self.keypoints.near(origin)
        points = self.points - origin.to(self.points.device)
        return replace(self, points=points, free_space=space, keypoints=keypoints, origin=origin)

    def rows(self, index: Tensor) -> Observation:
        """Return the observation of some clouds of a batch (B, M, 3), itself without a batch."""
        if self.points.ndim == 2:
            return self
        keypoints, frames = self.keypoints, tuple(self.frames[number] for number in index.tolist() if self.frames)
        if keypoints is not None and keypoints.targets.ndim == 3:
            keypoints = replace(keypoints, targets=keypoints.targets[index])
        everything = None if self.everything is None else (self.everything[0][index], self.everything[1][index])
        return replace(
            self,
            points=self.points[index],
            mask=None if self.mask is None else self.mask[index],
            free_space=None if self.free_space is None else self.free_space.rows(index),
            frames=frames,
            keypoints=keypoints,
            everything=everything,
        )

    @torch.no_grad()
    def drawn(self, shape: ArticulatedShape, nan_policy: str, seed: int, *, to_search: bool = False) -> Observation:
        """Return the same with at most as many points per cloud as poses are fitted to, evenly spread."""
        sizes = as_float_tensor(self.points, "data").shape
        is_large = len(sizes) > 1 and sizes[-2] > _FITTED.most
        count = _FITTED.searched if to_search else _FITTED.most
        if not is_large and (self.everything is None or not to_search):
            return self
        clouds, valid = check_clouds(shape, self.points, self.mask, nan_policy)
        if is_large and int(valid.sum(-1).max()) <= _FITTED.most:
            return self
        if self.frames:
            return replace(self._coarser(count, batched=clouds.ndim == 3), everything=(clouds, valid))
        size = model_size(sample_skin(shape, _FITTED.size_points))
        batch = zip(clouds.reshape(-1, *clouds.shape[-2:]), valid.reshape(-1, valid.shape[-1]), strict=True)
        points, mask = _padded([_draw(cloud[chosen], count, size, seed) for cloud, chosen in batch])
        points, mask = (points, mask) if clouds.ndim == 3 else (points[0], mask[0])
        return replace(self, points=points, mask=mask, everything=(clouds, valid))

    def _coarser(self, count: int, *, batched: bool) -> Observation:
        """Return what depth frames show with so many points at most."""
        frames = [
            DepthFrame(frame.depth, frame.camera, frame.mask, max_points=min(frame.max_points, count))
            for frame in self.frames
        ]
        seen = Observation.of(frames if batched else frames[0], None)
        return replace(seen if self.origin is None else seen.near(self.origin), keypoints=self.keypoints)

    def with_keypoints(self, shape: ArticulatedShape, keypoints: Any, std: Any) -> Observation:
        """Return the same with measured keypoints of a shape, None for none; see `MeasuredKeypoints`."""
        if keypoints is None:
            if std is not None:
                raise InputError("keypoint_std goes with keypoints; give both, or none")
            return self
        camera = self.frames[0].camera if self.frames else self.camera
        size = keypoint_extent(shape)
        return replace(self, keypoints=MeasuredKeypoints.of(shape, keypoints, std, camera, size))


@dataclass(frozen=True, eq=False)
class Task:
    """What `align` or `find_pose` is asked for, see there; ``seen`` follows once a picture is cropped.

    ``people``: the network that proposes them, if another than that of their body.
    ``in_picture``: whether it is sought in a whole picture, of which this is a crop that may show something else.
    """

    shape: ArticulatedShape
    source: StartSource
    config: AlignConfig
    model_points: Tensor | LinearBlendSkin | None = None
    known: KnownDofs | None = None
    start: Tensor | None = None
    fit_shape: bool = False
    people: PersonProposer | None = None
    clothed: bool | str = False
    support: str = "keep"
    in_picture: bool = False
    on_step: OnStep | None = None
    seen: Observation = Observation(None, None)

    def observed(self, data: Any, mask: Tensor | None, keypoints: Any, keypoint_std: Tensor | float | None) -> Task:
        """Return the task with what is observed, in coordinates that begin near it, see `floating_origin`."""
        seen = Observation.of(data, mask).without_support(self.shape, self.support)
        seen = seen.with_keypoints(self.shape, keypoints, keypoint_std)
        return to_local(replace(self, seen=seen), floating_origin(self.shape, seen.points))

    def near(self, origin: Tensor) -> Task:
        """Return the same in coordinates that begin at an origin (3,)."""
        start, points, told = self.start, self.model_points, self.on_step
        return replace(
            self,
            seen=self.seen.near(origin),
            known=to_local(self.known, origin),
            start=None if start is None else to_local(torch.as_tensor(start), origin),
            model_points=to_local(points, origin) if isinstance(points, Tensor) else points,
            on_step=None if told is None else lambda step: told(replace(step, pose=to_world(step.pose, origin))),
        )

    def skin(self, pose: Tensor | None = None) -> LinearBlendSkin:
        """Return the model points as a skin: given, built from points in a pose (1, num_dofs), or sampled."""
        points, shape, config = self.model_points, self.shape, self.config
        if isinstance(points, LinearBlendSkin):
            return check_skin(shape, points)
        if points is None:
            return sample_skin(shape, config.num_model_points, sharpness=config.sharpness)
        if pose is not None and len(pose) != 1:
            raise InputError("model_points given as a tensor need a single initial_pose; pass a skin for several poses")
        pose = shape.rest if pose is None else pose[0]
        return BendingSkin(shape, as_float_tensor(points, "model_points", like=shape.rest), pose, config.sharpness)

    def starts(self, clouds: Tensor, start: Tensor) -> Tensor:
        """Return checked starts (B, num_dofs) within the limits, one for each cloud or several for a single one."""
        shape, pose = self.shape, self.shape.check_pose(start, "initial_pose")
        if not bool(torch.isfinite(pose).all()):
            raise InputError("initial_pose must be finite")
        if pose.ndim > 2:
            raise InputError(f"initial_pose must have one or two dimensions, got shape {tuple(pose.shape)}")
        if clouds.ndim == 3 and pose.ndim == 2 and len(pose) not in (1, len(clouds)):
            raise InputError(f"initial_pose must hold one pose per cloud ({len(clouds)}), got {len(pose)}")
        single = len(pose) if pose.ndim == 2 else 1
        return shape.clamp(pose.expand(len(clouds) if clouds.ndim == 3 else single, shape.num_dofs))


def _padded(clouds: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return clouds (M, 3) of different sizes as one tensor (B, M, 3), and which of its points are theirs (B, M)."""
    counts = torch.tensor([len(cloud) for cloud in clouds], device=clouds[0].device)
    points = pad_sequence(list(clouds), batch_first=True)
    return points, torch.arange(points.shape[1], device=counts.device) < counts.unsqueeze(-1)


def _draw(cloud: Tensor, count: int, size: float, seed: int) -> Tensor:
    """Return at most ``count`` points of a cloud (M, 3), the same alone and in a batch."""
    if len(cloud) <= count:
        return cloud
    # Numbers drawn with a seed as it is may be those that made-up data were drawn with.
    generator = torch.Generator().manual_seed(seed)
    generator.manual_seed(int(torch.randint(2**31, (), generator=generator)))
    return cloud[draw_spread(cloud, count, size, generator)]


def check_clouds(
    shape: ArticulatedShape,
    clouds: Tensor,
    mask: Tensor | None,
    nan_policy: str,
    *,
    name: str = "data",
    mask_name: str = "mask",
    omit_option: str = "nan_policy='omit'",
) -> tuple[Tensor, Tensor]:
    """Return clouds (..., M, 3) in the shape's dtype and their valid points (..., M): neither masked nor left out."""
    clouds = as_float_tensor(clouds, name, like=shape.rest)
    if clouds.ndim not in (2, 3):
        raise InputError(f"{name} must have shape (M, 3) or (B, M, 3), got {tuple(clouds.shape)}")
    check_shape(clouds, name, ("M", 3), batch=True)
    if clouds.shape[-2] == 0 or clouds.shape[0] == 0:
        raise InputError(f"{name} must hold at least one point, got shape {tuple(clouds.shape)}")
    valid = torch.ones_like(clouds[..., 0], dtype=torch.bool)
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
            raise InputTypeError(f"{mask_name} must be a tensor of bool, False where {name} are padding")
        if mask.shape != valid.shape:
            expected, got = tuple(valid.shape), tuple(mask.shape)
            raise InputError(f"{mask_name} must have shape {expected} like the {name}, got {got}")
        valid = mask.to(clouds.device)
    finite = torch.isfinite(clouds).all(-1)
    bad = int((valid & ~finite).sum())
    if bad and nan_policy == "raise":
        raise InputError(f"{name} hold {bad} points that are not finite; drop them or set {omit_option}")
    valid = valid & finite
    if not bool(valid.any()):
        raise InputError(f"{name} hold no point that is finite and not masked")
    return torch.where(valid.unsqueeze(-1), clouds, 0.0), valid


def _remedy(ratio: float) -> str:
    """Return what to do about data that spread over some sizes of the model; those in metres do over about one."""
    # Inches differ too little from centimeters, which are far more common, for the size of a cloud to tell.
    unit, factor = likely_unit(ratio, {name: size for name, size in LENGTHS.items() if name != "inches"})
    return f"If they are in {unit}, load them with scale={factor:g}"


def floating_origin(shape: ArticulatedShape, clouds: Tensor) -> Tensor | None:
    """Return the origin (3,) about which far clouds are aligned; None for near clouds and bolted shapes."""
    if not isinstance(clouds, Tensor) or clouds.ndim < 2 or clouds.shape[-1] != 3:
        return None
    return far_origin(clouds) if bool(torch.isinf(shape.lower[:3]).all()) else None


def check_skin(shape: ArticulatedShape, skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return model points given as a skin of the shape, with constant weights."""
    if not isinstance(skin, LinearBlendSkin):
        raise InputTypeError(
            f"model_points must be a skin of the shape, as from sample_skin, got {type(skin).__name__}"
        )
    if skin.shape is not shape:
        raise InputError("model_points is a skin of another shape; build it from the shape itself")
    return skin.frozen()


def warn_about_units(data: Tensor, valid: Tensor, size: float, *, stacklevel: int) -> bool:
    """Return True, after a `UnitsWarning`, if the size of clouds of ten points or more is not in the shape's units."""
    radius = torch.where(valid, data.norm(dim=-1), torch.nan).nanmedian(-1).values
    ratio = 2 * float(radius.nanmedian()) / size
    # Data at one place have no size in any unit.
    if int(valid.sum(-1).max()) < UNITS.min_data or ratio < SAME_SHARE or 1 / UNITS.ratio < ratio < UNITS.ratio:
        return False
    warnings.warn(
        f"the data spread over {ratio:.3g} times the model's size of {size:.3g} m: are they in metres? "
        f"{_remedy(ratio)}",
        UnitsWarning,
        stacklevel=stacklevel + 1,
    )
    return True


def are_degenerate(data: Tensor, valid: Tensor, size: float) -> Tensor:
    """Return which clouds ((B,)) of ten or more points lie at one place, on a line or on a plane."""
    return (spread_dimensions(data, size, valid) < len(SPREADS)) & (valid.sum(-1) >= UNITS.min_data)


def warn_about_degenerate(data: Tensor, valid: Tensor, size: float, *, stacklevel: int) -> Tensor:
    """Return `are_degenerate`, after a `DegenerateDataWarning` about the worst of such clouds."""
    degenerate = are_degenerate(data, valid, size)
    if bool(degenerate.any()):
        where = SPREADS[int(spread_dimensions(data, size, valid)[degenerate].min())]
        warnings.warn(
            f"the data lie {where}, within a thousandth of their extent: they determine no pose; check what was "
            f"measured",
            DegenerateDataWarning,
            stacklevel=stacklevel + 1,
        )
    return degenerate
