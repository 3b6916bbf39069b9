"""Scenes of results - an alignment, a tracked sequence, registered scans, a spine - and of shapes, scans and clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.alignment.results import AlignResult, Calibration, PoseStarts
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.points import PointCloud
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.results import ScanRegistration, SequenceRegistration
from torchreg.registration.rigging.results import SequenceRig
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.spines.results import SpineSequence
from torchreg.tracking.results import DemoResult, TrackResult
from torchreg.viz.bone_colors import bone_palette, error_colors, weight_colors
from torchreg.viz.key_poses import between_poses
from torchreg.viz.posed_scenes import DATA_COLORS, frame_labels, inlier_paint, near_surface, posed_scene, shape_layers
from torchreg.viz.scene import Cloud, Color, Curves, Layer, Meshes, MovingMesh, Scene

Data = Sequence[Tensor | TriangleMesh]


@dataclass(frozen=True)
class _SceneStyle:
    """Colors, red, green and blue from 0 to 1, and numbers of the scenes."""

    source: Color = (0.62, 0.62, 0.64)
    target: Color = (0.45, 0.52, 0.62)
    body: Color = (0.78, 0.76, 0.74)
    keypoint: Color = (0.85, 0.25, 0.2)
    num_samples: int = 64  # points of a limb of a skeleton
    num_steps: int = 25  # frames from a scan to its registration


_STYLE = _SceneStyle()


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, in the plural unless it is one."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def result_scene(result: Any, *, shape: ArticulatedShape | None = None, data: Data = ()) -> Scene:
    """Return the scene of a result, or of a shape at rest, a mesh, a scan or a cloud.

    Args:
        result: of any system: an `AlignResult`, `TrackResult`, `DemoResult`, `PoseStarts`, `Calibration`,
            `ScanRegistration`, `SequenceRegistration`, `SequenceRig` or `SpineSequence`; or an `ArticulatedShape`,
            `TriangleMesh`, `RangeScan`, `PointCloud`, `Skeleton` or tensor (N, 3), or a list of meshes or tensors, one
            per frame.
        shape: that was aligned or tracked, by default the one that the result keeps; where there is none, keypoints and
            registered points alone are shown.
        data: measurements, one cloud or mesh per frame: the clouds of alignments and sequences, the target of a
            registration, the surfaces of a spine; optional.

    Raises:
        InputError: if sizes do not fit, or ``shape`` is given for a result of scans.
        InputTypeError: if there is no scene of such a result.
    """
    if shape is not None and isinstance(result, (ScanRegistration, SequenceRegistration, SpineSequence)):
        raise InputError(f"shape has no meaning for a {type(result).__name__}; leave it out")
    if shape is None and isinstance(result, (AlignResult, TrackResult, PoseStarts)):
        shape = result.shape
    if shape is None and isinstance(result, DemoResult):
        shape = result.track.shape
    return _scene(result, shape, data)


@singledispatch
def _scene(result: Any, shape: ArticulatedShape | None, data: Data) -> Scene:
    raise InputTypeError(f"result must be one that can be shown, not a {type(result).__name__}")


@_scene.register
def _align_scene(result: AlignResult, shape: ArticulatedShape | None, data: Data) -> Scene:
    poses = _batched(result.pose, 1)
    masks, posterior = _batched(result.inliers, 1), _batched(result.posterior, 1)
    clouds = _clouds(data, len(poses))
    layers = shape_layers(shape, poses)
    registered = list(_batched(result.registered, 2))
    layers.append(_cloud("registered points", registered, DATA_COLORS.inlier, visible=shape is None))
    layers.append(_keypoints(_batched(result.keypoints, 2), visible=shape is None))
    for frame, cloud in enumerate(clouds):
        check_shape(masks[frame], "result.inliers", (len(cloud),))
    if clouds:
        paints = [inlier_paint(mask, share) for mask, share in zip(masks, posterior, strict=True)]
        layers.append(_cloud("data", clouds, paints))
    title = f"alignment: {', '.join(sorted({status.value for status in result.statuses}))}"
    return Scene(title, tuple(layers), up=result.up, facts=_align_facts(result))


def _align_facts(result: AlignResult) -> dict[str, str]:
    """Return confidence, inliers and residual of a single alignment in words."""
    if isinstance(result.status, tuple):
        return {}
    near = result.distances[result.inliers]
    facts = {"inliers": f"{len(near):,} of {len(result.distances):,}"}
    if len(near):
        facts["residual"] = f"{1e3 * float(near.square().mean().sqrt()):.1f} mm"
    if result.confidence is not None:
        facts["confidence"] = f"{float(result.confidence):.2f}"
    return facts | ({"doubtful": str(result.doubt)} if result.doubt else {})


@_scene.register
def _track_scene(result: TrackResult, shape: ArticulatedShape | None, data: Data) -> Scene:
    clouds = _clouds(data, len(result.poses))
    title = counted(len(result.poses), "tracked frame")
    if shape is not None:
        scene = posed_scene(
            shape, result.poses, clouds, near_surface(shape, result.poses), usable=_usable(result.statuses),
            captions=frame_labels(result), times=result.times, up=result.up, title=title,
        )  # fmt: skip
        keypoints = _keypoints(result.keypoints, visible=False)
        return replace(scene, layers=(*scene.layers, keypoints), facts=_status_facts(result))
    layers: list[Layer] = [_keypoints(result.keypoints, visible=True)]
    if clouds:
        layers.append(_cloud("data", clouds, DATA_COLORS.inlier))
    return Scene(title, tuple(layers), result.times, result.up, _status_facts(result))


def _usable(statuses: Sequence[Status]) -> list[bool]:
    return [status.usable for status in statuses]


def _status_facts(result: TrackResult) -> dict[str, str]:
    """Return the number of frames of each status in words."""
    kinds = [status.value for status in result.statuses]
    return {kind: counted(kinds.count(kind), "frame") for kind in sorted(set(kinds))}


@_scene.register
def _demo_scene(result: DemoResult, shape: ArticulatedShape | None, data: Data) -> Scene:
    hand = Hand() if shape is None else shape
    facts = _status_facts(result.track)
    if result.tips_seen.any():
        facts["error of seen fingertips"] = f"{1e3 * float(result.tip_errors[result.tips_seen].mean()):.1f} mm"
    scene = posed_scene(
        hand, result.track.poses, result.clouds, result.inliers, usable=_usable(result.track.statuses),
        captions=frame_labels(result.track), times=result.track.times, title=f"demo, seed {result.seed}",
    )  # fmt: skip
    return replace(scene, facts=facts)


@_scene.register
def _starts_scene(result: PoseStarts, shape: ArticulatedShape | None, data: Data) -> Scene:
    if shape is None:
        raise InputError("shape must be given to show a PoseStarts, which holds poses alone")
    poses = result.poses.reshape(-1, result.poses.shape[-1])
    layers = shape_layers(shape, poses)
    if data:
        layers.append(_cloud("data", _clouds(data, 1), DATA_COLORS.inlier))
    return Scene("poses found, best first", tuple(layers), torch.arange(float(len(poses))))


@_scene.register
def _calibration_scene(result: Calibration, shape: ArticulatedShape | None, data: Data) -> Scene:
    clouds = _clouds(data, len(result.poses))
    layers = shape_layers(result.shape, result.poses)
    if shape is not None:
        given = shape_layers(shape, result.poses)
        layers += [replace(layer, name=f"given {layer.name}", visible=False) for layer in given]
    if clouds:
        layers.append(_cloud("data", clouds, DATA_COLORS.inlier))
    return Scene("calibrated shape", tuple(layers))


@_scene.register
def _registration_scene(result: ScanRegistration, shape: None, data: Data) -> Scene:
    with torch.no_grad():
        rest = torch.eye(4).to(result.transforms).expand_as(result.transforms)
        keys = torch.stack([rest, result.transforms])
        poses = between_poses(result.model, keys, torch.linspace(0, 1, _STYLE.num_steps))
        moving = result.model.move(result.points, result.weights, poses)
    moving[-1] = result.deformed
    errors = result.distances.clamp(min=0).nan_to_num(0.0, 0.0)
    largest = float(errors.quantile(0.98)) or 1.0
    faces = result.faces
    layers = [
        _scan("source", result.points, faces, _STYLE.source, visible=False),
        _scan("moved, by bones", moving, faces, weight_colors(result.weights).clamp(0, 1)),
        _scan(f"moved, by error (red: {largest:.3g})", moving, faces, error_colors(errors, largest), visible=False),
        _bones(result.model, poses),
    ]
    for target in data[:1]:
        layers.append(_scan("target", _vertices(target), getattr(target, "faces", None), _STYLE.target, opacity=0.5))
    title = f"{counted(result.model.num_bones, 'bone')}, {float(result.matched.float().mean()):.0%} of the points match"
    facts = {"status": result.status.value, "distance, median": f"{float(errors.median()):.3g}"}
    if result.confidence is not None:
        facts["confidence"] = f"{result.confidence:.2f}"
    return Scene(title, tuple(layers), torch.linspace(0, 2, _STYLE.num_steps), result.up, facts)


@_scene.register
def _sequence_scene(result: SequenceRegistration, shape: None, data: Data) -> Scene:
    clouds = _clouds(data, len(result.deformed))
    layers = [
        _scan("reference, by bones", result.deformed, result.faces, weight_colors(result.weights).clamp(0, 1)),
        _bones(result.model, result.transforms),
    ]
    if len(result.fused):
        hue = bone_palette(len(result.deformed)).to(result.fused)[result.fused_frames]
        layers.append(_cloud("fused, by frame", [result.fused], [hue], visible=False))
    if clouds:
        layers.append(_cloud("scans", clouds, _STYLE.target))
    title = f"{counted(len(result.deformed), 'scan')}, {counted(result.model.num_bones, 'bone')}"
    facts = {"status": result.status.value}
    if result.confidence is not None:
        facts["confidence, worst scan"] = f"{float(result.confidence.min()):.2f}"
    return Scene(title, tuple(layers), up=result.up, facts=facts)


@_scene.register
def _rig_scene(result: SequenceRig, shape: ArticulatedShape | None, data: Data) -> Scene:
    rig = result.shape
    clouds = _clouds(data, len(result.poses))
    scene = posed_scene(
        rig, result.poses, clouds, near_surface(rig, result.poses), skin=rig.file_skin(), up=result.up,
        title=f"{counted(len(result.poses), 'frame')}, {counted(len(result.joints), 'bone')}",
    )  # fmt: skip
    worst = float(result.errors.nan_to_num(0.0).max())
    return replace(scene, facts={"status": result.status.value, "distance, worst frame": f"{worst:.2%} of the size"})


@_scene.register
def _spine_scene(result: SpineSequence, shape: None, data: Data) -> Scene:
    paint = bone_palette(len(result.graph))
    tips = tuple(str(number) for number in range(result.num_tips))
    # Organs that are not there have no length.
    curves = torch.where(result.curves.isnan(), result.model(result.times).detach(), result.curves)
    layers: list[Layer] = [Curves("limbs", curves, paint, labels=tips, dashed=~result.own, thickness=0.009)]
    if data and len(data) != len(result.curves):
        raise InputError(f"data must hold one surface per frame ({len(result.curves)}), got {len(data)}")
    layers += _surface_frames(data)
    title = f"{counted(result.num_tips, 'tip')}, {counted(len(result.graph), 'limb')}"
    facts = {"status": result.status.value}
    if result.confidence is not None:
        facts["confidence of names"] = f"{float(result.confidence.nan_to_num(1.0).min()):.2f} and more"
    return Scene(title, tuple(layers), result.times, result.up, facts)


@_scene.register
def _skeleton_scene(result: Skeleton, shape: None, data: Data) -> Scene:
    curves = result.resample(_STYLE.num_samples)[0]
    tips = tuple(str(number) for number in range(len(result.tips)))
    layers = [Curves("limbs", curves, bone_palette(len(curves)), labels=tips, thickness=0.009), *_surface_frames(data)]
    return Scene(counted(len(curves), "limb"), tuple(layers))


@_scene.register
def _shape_scene(result: ArticulatedShape, shape: None, data: Data) -> Scene:
    title = f"{counted(result.num_parts, 'part')}, {result.num_dofs} degrees of freedom"
    return Scene(title, tuple(shape_layers(result, result.rest_pose()[None])))


@_scene.register
def _mesh_scene(result: TriangleMesh, shape: None, data: Data) -> Scene:
    title = f"{result.num_vertices:,} vertices, {counted(len(result.faces), 'triangle')}"
    return Scene(title, (_scan("mesh", result.vertices, result.faces, _STYLE.body),))


@_scene.register(RangeScan)
@_scene.register(PointCloud)
def _scan_scene(result: RangeScan | PointCloud, shape: None, data: Data) -> Scene:
    colors = getattr(result, "colors", None)
    paint = _STYLE.target if colors is None else colors.detach().cpu().float()
    triangles = "" if result.faces is None or not len(result.faces) else f", {counted(len(result.faces), 'triangle')}"
    title = f"{counted(len(result.points), 'point')}{triangles}"
    return Scene(title, (_scan("scan", result.points, result.faces, paint),))


@_scene.register
def _points_scene(result: Tensor, shape: None, data: Data) -> Scene:
    return Scene(counted(len(result), "point"), (_cloud("points", [result], _STYLE.target),))


@_scene.register
def _frames_scene(result: list, shape: None, data: Data) -> Scene:
    if not result:
        raise InputError("result must hold a mesh or cloud at least, got none")
    return Scene(counted(len(result), "frame"), tuple(_surface_frames(result, opacity=1.0)))


def _surface_frames(data: Data, opacity: float = 0.3) -> list[Layer]:
    """Return the layer of meshes, one per frame, or else of their points; none without data."""
    if not isinstance(data, (list, tuple)):
        return [Meshes("surface", data, _STYLE.body, opacity=opacity)]  # type: ignore[arg-type]  # read when shown
    meshes = [item for item in data if isinstance(item, TriangleMesh)]
    if meshes and len(meshes) == len(data):
        return [Meshes("surface", meshes, _STYLE.body, opacity=opacity)]
    clouds = [_vertices(item).detach() for item in data]
    return [Cloud("surface", clouds, _STYLE.body, size=0.003)] if clouds else []


def _bones(model: GridLBS, poses: Tensor) -> Curves:
    """Return the bones of a model in poses (T, B, 4, 4), from each joint to those of its children."""
    tree = model.skeleton(poses)
    joints = transform_points(poses, tree.origins.to(poses).unsqueeze(-2)).squeeze(-2).detach()
    pairs = [(parent if parent >= 0 else bone, bone) for bone, parent in enumerate(tree.parents)]
    return Curves("bones", joints[:, torch.tensor(pairs)], bone_palette(len(pairs)), visible=False)


def _scan(
    name: str,
    points: Tensor,
    faces: Tensor | None,
    paint: Tensor | Color,
    *,
    visible: bool = True,
    opacity: float = 1.0,
) -> Layer:
    """Return the layer of a scan: a mesh if it has triangles, else points."""
    points = points.detach()
    if faces is not None and len(faces):
        return MovingMesh(name, points, faces, paint, opacity=opacity, visible=visible)
    frames = list(points) if points.ndim == 3 else [points]
    return _cloud(name, frames, paint if isinstance(paint, tuple) else [paint] * len(frames), visible=visible)


def _cloud(
    name: str, frames: Sequence[Tensor], paints: Sequence[Tensor] | Color, *, size: float = 0.006, visible: bool = True
) -> Cloud:
    """Return a layer of clouds without the points that are not finite."""
    keep = [points.isfinite().all(-1) for points in frames]
    if not isinstance(paints, tuple):
        paints = [paint[mask] for paint, mask in zip(paints, keep, strict=True)]
    shown = [points.detach()[mask] for points, mask in zip(frames, keep, strict=True)]
    return Cloud(name, shown, paints, size=size, visible=visible)


def _keypoints(points: Tensor, *, visible: bool) -> Cloud:
    return _cloud("keypoints", list(points), _STYLE.keypoint, size=0.02, visible=visible)


def _clouds(data: Data, count: int) -> list[Tensor]:
    if data and len(data) != count:
        raise InputError(f"data must hold one cloud per frame ({count}), got {len(data)}")
    return [_vertices(item).detach().cpu() for item in data]


def _vertices(item: Tensor | TriangleMesh) -> Tensor:
    return item.vertices if isinstance(item, TriangleMesh) else item


def _batched(value: Tensor, dimensions: int) -> Tensor:
    """Return a tensor on the CPU with a leading dimension of frames, added if it lacks one."""
    return value.detach().cpu().unsqueeze(0) if value.ndim == dimensions else value.detach().cpu()
