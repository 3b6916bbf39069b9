"""Pairs of partial scans of made-up creatures in two poses, with the truth both ways: a stream without end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg.datasets.depth_scanner import DepthScanner, SurfaceScan
from torchreg.datasets.figures import Figure, meshed_figure
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp

from ..made_up.creature_kinds import TRAINING_KINDS, Kind
from ..made_up.creature_parts import Draw
from ..made_up.scans_in_company import TrueScan


@dataclass(frozen=True)
class _Variety:
    """What differs between the pairs of a stream; lengths are shares of the creature's diagonal."""

    pairs_per_creature: int = 6  # poses are cheap beside a new surface
    cells: float = 75.0  # of the grid on which the surface is found, along the diagonal
    blend: tuple[float, float] = (0.003, 0.02)  # radius of the seams
    softness: tuple[float, float] = (0.006, 0.025)  # over which the skin bends
    warp: float = 0.03  # amplitude of a smooth warp of the rest shape
    stretch: tuple[float, float] = (0.75, 1.35)  # of each axis, in half of the creatures
    folds: float = 0.012  # amplitude of folds that differ between both poses, in a third of the creatures
    first_pose: float = 35.0  # largest angle of a joint in the first pose, degrees
    half_step: float = 0.2  # share of the pairs whose second pose begins as the first one in a mirror
    symmetric: float = 0.05  # a joint has a partner where its place in the mirror is this near to it
    motion: tuple[float, float] = (6.0, 80.0)  # largest change of a joint from the first pose to the second, degrees
    largest_angle: float = 95.0  # of any joint, degrees
    clip_share: float = 0.75  # of the pairs of a body with clips begin with a frame of one
    clip_pose: float = 0.25  # of those end in a random pose near that frame, the others in a frame of any clip
    same_clip: float = 0.5  # of the latter in a frame of the same clip
    distance: tuple[float, float] = (2.2, 6.0)  # of the camera, in radii of the creature
    camera_turn: tuple[float, float] = (8.0, 50.0)  # between both scans, in a third of the pairs, degrees
    scan_turn: float = 50.0  # of a scan in its own coordinates, in two fifths, degrees; any in a tenth
    num_points: tuple[int, int] = (1400, 3500)
    noise: float = 0.003
    hole_radius: tuple[float, float] = (0.02, 0.09)
    least_points: int = 700
    visible: float = 0.03  # a point counts as visible with a point of the other scan this near, facing alike
    least_visible: float = 0.25  # of the source: with fewer there is little to learn


_VARIETY = _Variety()


@dataclass(frozen=True, eq=False)
class MatchingPair:
    """Two partial scans of a creature in two poses, and the truth both ways.

    Args:
        kind: name of the creature's kind.
        source: N points.
        target: M points.
        source_truth: (N, 3) where the source's points are in the target's pose and coordinates.
        source_visible: (N,) bool, whether the target's scan shows that place.
        target_truth: (M, 3) the same the other way.
        target_visible: (M,) bool.
    """

    kind: str
    source: RangeScan
    target: RangeScan
    source_truth: Tensor
    source_visible: Tensor
    target_truth: Tensor
    target_visible: Tensor


@dataclass(frozen=True, eq=False)
class PosableBody:
    """A surface that can be posed at random.

    Args:
        figure: the surface and its parts.
        limits: (P,) largest angles of the joints, radians.
        rigid: whether its parts are rigid pieces.
        clips: rotations (F, P, 3, 3) of the parts against their parents in the frames of each.
    """

    figure: Figure
    limits: Tensor
    rigid: bool = False
    clips: tuple[Tensor, ...] = ()


def matching_pairs(
    seed: int = 0,
    kinds: Mapping[str, tuple[Kind, float]] | None = None,
    *,
    bodies: Callable[[Draw], tuple[str, PosableBody]] | None = None,
    body_share: float = 0.4,
    whole: float = 0.0,
    rough: float = 0.0,
) -> Iterator[MatchingPair]:
    """Yield pairs of scans of creatures, each creature new at every few pairs, without end.

    Args:
        seed: two streams of different seeds share nothing.
        kinds: what is drawn, with the share of each; `TRAINING_KINDS` by default.
        bodies: draws a further body, such as a rig of a user, and its kind; each is warped and scaled anew.
        body_share: of the pairs that show one of those.
        whole: of the pairs whose scans are of all sides, as complete meshes are.
        rough: of the pairs whose target stands among other things, and of those whose scans are bare clouds; the source
            has company in a third of as many.

    Cost: 0.3 s a pair.
    """
    draw = Draw(torch.Generator().manual_seed(seed))
    kinds = TRAINING_KINDS if kinds is None else kinds
    names, shares = list(kinds), [share for _, share in kinds.values()]
    others: list[RangeScan] = []  # of the creature before
    while True:
        if bodies is not None and draw.chance(body_share):
            kind, body = bodies(draw)
        else:
            kind = names[int(torch.multinomial(torch.tensor(shares), 1, generator=draw.generator))]
            body = drawn_body(kinds[kind][0], draw)
        body, before = _warped(body, draw), others
        for _ in range(_VARIETY.pairs_per_creature):
            pair = _pair(kind, body, draw, whole=whole > 0 and draw.chance(whole))
            if pair is not None:
                others = [pair.source, pair.target]
                yield _roughened(pair, before, rough, draw) if rough > 0 else pair


def drawn_body(kind: Kind, draw: Draw) -> PosableBody:
    """Return a new creature of a kind as a surface."""
    creature = kind(draw)
    corners = torch.tensor([corner for part in creature.parts for solid in part.solids for corner in solid.bounds()])
    size = float((corners.amax(0) - corners.amin(0)).norm())
    skin: dict[str, Any] = {}
    if not creature.rigid:
        skin["blend"] = size * draw.log_uniform(*_VARIETY.blend)
        skin["softness"] = size * draw.log_uniform(*_VARIETY.softness)
    figure = meshed_figure(creature.parts, spacing=size / _VARIETY.cells, **skin)
    return PosableBody(figure, torch.tensor(creature.limits, dtype=torch.float64), creature.rigid)


def _warped(body: PosableBody, draw: Draw) -> PosableBody:
    """Return a body one unit in diagonal, about the origin, its rest shape warped smoothly and stretched."""
    vertices, joints = body.figure.mesh.vertices.double(), body.figure.joints.double()
    lower, upper = vertices.amin(0), vertices.amax(0)
    middle, size = (lower + upper) / 2, (upper - lower).norm()
    warp = _waves(draw, _VARIETY.warp * draw.uniform(0, 1.5), (1.0, 7.0))
    stretch = torch.ones(3, dtype=torch.float64)
    if draw.chance(0.5) and not body.rigid:
        stretch = torch.tensor([draw.uniform(*_VARIETY.stretch) for _ in range(3)], dtype=torch.float64)

    def moved(points: Tensor) -> Tensor:
        points = (points - middle) / size
        return stretch * (points if body.rigid else points + warp(points))

    mesh = TriangleMesh(moved(vertices), body.figure.mesh.faces)
    return replace(body, figure=replace(body.figure, mesh=mesh, joints=moved(joints)))


def _waves(
    draw: Draw, amplitude: float, frequencies: tuple[float, float], count: int = 6
) -> Callable[[Tensor], Tensor]:
    """Return a smooth random vector field on points (..., 3) of one unit in size."""
    wave = draw.normal(count, 3) * torch.tensor([[draw.uniform(*frequencies)] for _ in range(count)])
    phase, along = 2 * math.pi * draw.normal(count), amplitude * draw.normal(count, 3) / math.sqrt(count)
    return lambda points: (points @ wave.mT + phase).sin() @ along


def _pair(kind: str, body: PosableBody, draw: Draw, *, whole: bool) -> MatchingPair | None:
    """Return a pair of scans of a body in two random poses; None where little of both is common."""
    meshes = two_poses(body, draw)
    scans = [_whole_scan(mesh, draw) for mesh in meshes] if whole else _two_scans(body, meshes, draw)
    if scans is None:
        return None
    sides = []
    for (found, _), (other, turn), mesh in zip(scans, scans[::-1], meshes[::-1], strict=True):
        truth, normals = (
            interpolate(values, mesh.faces, found.face, found.barycentric)
            for values in (mesh.vertices, mesh.vertex_normals())
        )
        truth, normals = truth @ turn.mT, normals @ turn.mT
        nearest, distance = NeighborTree(other.scan.points.double()).nearest(truth)
        facing = (normals * other.scan.normals.double()[nearest]).sum(-1) > 0
        sides.append((truth.float(), facing & (distance < _VARIETY.visible * other.scan.diagonal)))
    (source_truth, source_visible), (target_truth, target_visible) = sides
    if float(source_visible.double().mean()) < _VARIETY.least_visible:
        return None
    return MatchingPair(
        kind=kind,
        source=scans[0][0].scan,
        target=scans[1][0].scan,
        source_truth=source_truth,
        source_visible=source_visible,
        target_truth=target_truth,
        target_visible=target_visible,
    )


def _roughened(pair: MatchingPair, others: list[RangeScan], rough: float, draw: Draw) -> MatchingPair:
    """Return a pair with other things in it, and as bare clouds, by their chances."""
    sides = []
    for name, share in (("source", rough / 3), ("target", rough)):
        other = others[draw.count(0, len(others) - 1)] if others else None
        own = TrueScan(*(getattr(pair, name + end) for end in ("", "_truth", "_visible")))
        sides.append(own.roughened(other, draw, company=share, cloud=rough))
    # Of what one scan shows a window of the other may have cut some off.
    source, target = (
        replace(mine, visible=mine.visible & _near(mine.truth, theirs.scan)) for mine, theirs in (sides, sides[::-1])
    )
    return replace(
        pair, source=source.scan, source_truth=source.truth, source_visible=source.visible,
        target=target.scan, target_truth=target.truth, target_visible=target.visible,
    )  # fmt: skip


def _near(places: Tensor, scan: RangeScan) -> Tensor:
    """Return which places (N, 3) a scan has points next to."""
    return NeighborTree(scan.points.double()).nearest(places.double())[1] < _VARIETY.visible * scan.diagonal


def two_poses(body: PosableBody, draw: Draw) -> tuple[TriangleMesh, TriangleMesh]:
    """Return the surface in two poses of clips, or in a random one and after a motion from a few degrees to wild."""
    figure = body.figure
    from_clips = bool(body.clips) and draw.chance(_VARIETY.clip_share)
    rotations = _clip_rotations(body, draw) if from_clips else _random_rotations(body, draw)
    rests = [figure.mesh, figure.mesh]
    if not body.rigid and draw.chance(0.35):
        rests = [_folded(mesh, draw) for mesh in rests]
    posed = [
        replace(figure, mesh=mesh).vertices(figure.transforms(turns))
        for mesh, turns in zip(rests, rotations, strict=True)
    ]
    return TriangleMesh(posed[0], figure.mesh.faces), TriangleMesh(posed[1], figure.mesh.faces)


def _clip_rotations(body: PosableBody, draw: Draw) -> tuple[Tensor, Tensor]:
    """Return rotations (P, 3, 3) of a frame of a clip and of another frame, of any clip, or of a pose near it."""
    clip = body.clips[draw.count(0, len(body.clips) - 1)]
    first = clip[draw.count(0, len(clip) - 1)]
    if draw.chance(_VARIETY.clip_pose):
        return first, first @ so3_exp(_motion(body, draw))
    if not draw.chance(_VARIETY.same_clip):
        clip = body.clips[draw.count(0, len(body.clips) - 1)]
    return first, clip[draw.count(0, len(clip) - 1)]


def _random_rotations(body: PosableBody, draw: Draw) -> tuple[Tensor, Tensor]:
    """Return rotations (P, 3, 3) of two random poses."""
    first = _angles(body, draw, draw.uniform(0, _VARIETY.first_pose), 0.8)
    # As after half a step: left limbs are where right ones were.
    start = _mirrored(first, body) if draw.chance(_VARIETY.half_step) else first
    second = start + _motion(body, draw)
    size = second.norm(dim=-1, keepdim=True)
    second = second * (math.radians(_VARIETY.largest_angle) / size.clamp_min(1e-9)).clamp(max=1)
    return so3_exp(first), so3_exp(second)


def _motion(body: PosableBody, draw: Draw) -> Tensor:
    """Return rotation vectors (P, 3) of a motion from a few degrees to wild."""
    return _angles(body, draw, draw.log_uniform(*_VARIETY.motion), draw.uniform(0.35, 1))


def _angles(body: PosableBody, draw: Draw, largest: float, active: float) -> Tensor:
    """Return rotation vectors (P, 3) up to an angle, degrees, of a share of the joints."""
    count = body.figure.num_parts
    axis = draw.normal(count, 3) * torch.tensor([2.0, 1.0, 1.0])  # mostly swings in the plane of the body
    axis = torch.nn.functional.normalize(axis, dim=-1)
    share = 2 * torch.rand(count, 1, generator=draw.generator, dtype=torch.float64) - 1
    moving = torch.rand(count, 1, generator=draw.generator, dtype=torch.float64) < active
    return axis * share * body.limits.clamp(max=math.radians(largest)).unsqueeze(-1) * moving


def _mirrored(turns: Tensor, body: PosableBody) -> Tensor:
    """Return the rotation vectors (P, 3) of a pose seen in a mirror: joints without a partner turn as they did."""
    reflected = body.figure.joints * torch.tensor([-1.0, 1.0, 1.0]).to(body.figure.joints)
    distance, partner = torch.cdist(reflected, body.figure.joints).min(1)
    # Turns are axial: of one in a mirror across x, the part about x stays.
    mirrored = turns[partner] * torch.tensor([1.0, -1.0, -1.0]).to(turns)
    return torch.where((distance < _VARIETY.symmetric).unsqueeze(-1), mirrored, turns)


def _folded(mesh: TriangleMesh, draw: Draw) -> TriangleMesh:
    """Return a surface with folds, as cloth and loose skin have them, anew in every pose."""
    field = _waves(draw, _VARIETY.folds * draw.uniform(0.2, 1), (10.0, 30.0))
    along = field(mesh.vertices).sum(-1, keepdim=True)
    return TriangleMesh(mesh.vertices + along * mesh.vertex_normals(), mesh.faces)


def _two_scans(
    body: PosableBody, meshes: tuple[TriangleMesh, TriangleMesh], draw: Draw
) -> list[tuple[SurfaceScan, Tensor]] | None:
    """Return scans of both surfaces and the rotations (3, 3) that take the surfaces to the coordinates of the scans."""
    view = _random_rotation(draw, 180.0) if draw.chance(0.3) else _upright_view(draw)
    second = view
    if draw.chance(1 / 3):
        second = _rotation(draw.direction(), draw.uniform(*_VARIETY.camera_turn)) @ view
    absent = _absent_part(body, draw)
    scans = []
    for number, (mesh, facing) in enumerate(zip(meshes, (view, second), strict=True)):
        found = _scan(mesh, facing, absent if number == 1 else None, draw)
        if found is None:
            return None
        turn = _scan_turn(draw)
        motion = rigid_matrix(turn @ facing.mT, torch.zeros(3, dtype=torch.float64))
        # The turn and shift to before the camera go again; a turn of the scan stays.
        scans.append((replace(found, scan=found.scan.transformed(motion.to(found.scan.points))), turn))
    return scans


def _whole_scan(mesh: TriangleMesh, draw: Draw) -> tuple[SurfaceScan, Tensor]:
    """Return points of all sides of a surface, and the rotation (3, 3) that takes the surface to their coordinates."""
    turn = _scan_turn(draw)
    turned = TriangleMesh(mesh.vertices @ turn.mT, mesh.faces)
    points, face, shares = sample_surface(turned, draw.count(*_VARIETY.num_points), generator=draw.generator)
    diagonal = float((turned.vertices.amax(0) - turned.vertices.amin(0)).norm())
    noise = _VARIETY.noise * draw.uniform(0, 1) * diagonal * draw.normal(*points.shape)
    normals = interpolate(turned.vertex_normals(), mesh.faces, face, shares)
    scan = RangeScan((points + noise).float(), normals=torch.nn.functional.normalize(normals, dim=-1).float())
    return SurfaceScan(scan, face, shares), turn


def _scan(mesh: TriangleMesh, facing: Tensor, absent: Tensor | None, draw: Draw) -> SurfaceScan | None:
    """Return the scan by a camera before which a surface is turned, in the coordinates of the turned surface."""
    turned = mesh.vertices @ facing.mT
    lower, upper = turned.amin(0), turned.amax(0)
    middle = (lower + upper) / 2
    radius = float((turned - middle).norm(dim=-1).max())
    distance = radius * draw.uniform(*_VARIETY.distance)
    offset = torch.tensor([0.0, 0.0, distance], dtype=torch.float64) - middle
    faces = mesh.faces if absent is None else mesh.faces[~absent[mesh.faces].all(-1)]
    before = TriangleMesh(turned + offset, faces)
    diagonal = float((upper - lower).norm())
    scanner = DepthScanner(
        num_points=draw.count(*_VARIETY.num_points),
        noise=_VARIETY.noise * draw.uniform(0, 1) * diagonal / distance**2,
        num_holes=draw.count(1, 3) if draw.chance(0.4) else 0,
        hole_radius=draw.uniform(*_VARIETY.hole_radius),
    )
    try:
        view = scanner.view(before, radius / math.sqrt(distance**2 - radius**2))
        found = scanner.scan(before, view, draw.generator, torch.float32)
    except InputError:  # nothing in sight, or no three pixels that join
        return None
    kept = _kept(found.scan, draw)
    if int(kept.sum()) < _VARIETY.least_points:
        return None
    scan = found.scan.subset(kept, mark_cut=True) if not bool(kept.all()) else found.scan
    number = torch.arange(len(mesh.faces)) if absent is None else (~absent[mesh.faces].all(-1)).nonzero()[:, 0]
    shift = rigid_matrix(torch.eye(3), -offset.float())
    return SurfaceScan(scan.transformed(shift), number[found.face[kept]], found.barycentric[kept])


def _kept(scan: RangeScan, draw: Draw) -> Tensor:
    """Return which points (N,) are kept of a scan that is cut off in a tenth of the cases, and uneven in a third."""
    kept = torch.ones(len(scan), dtype=torch.bool)
    if draw.chance(0.1):
        along = scan.points.double() @ draw.direction()
        kept &= along > along.quantile(draw.uniform(0.05, 0.25))
    if draw.chance(0.3):
        along = (scan.points.double() - scan.points.double().mean(0)) @ draw.direction()
        chance = (draw.uniform(0.3, 1.2) * along / along.std()).exp().clamp(0.2, 5)
        kept &= torch.rand(len(scan), generator=draw.generator) < (chance / chance.quantile(0.7)).clamp(max=1)
    return kept


def _absent_part(body: PosableBody, draw: Draw) -> Tensor | None:
    """Return the vertices (V,) of a part without children that the second scan lacks, in a few pairs."""
    ends = [part for part in range(1, body.figure.num_parts) if part not in body.figure.parents]
    if not ends or not draw.chance(0.05):
        return None
    return body.figure.weights.argmax(-1) == ends[draw.count(0, len(ends) - 1)]


def _upright_view(draw: Draw) -> Tensor:
    """Return a rotation (3, 3) from y up to a camera that looks along +z with -y up, from anywhere around."""
    about = _rotation(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), draw.uniform(0, 360))
    return _rotation(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), 180 + draw.uniform(-60, 25)) @ about


def _scan_turn(draw: Draw) -> Tensor:
    """Return the rotation (3, 3) of a scan in its own coordinates: none, some, or any."""
    kind = draw.uniform(0, 1)
    return _random_rotation(draw, 0.0 if kind < 0.5 else _VARIETY.scan_turn if kind < 0.9 else 180.0)


def _random_rotation(draw: Draw, largest: float) -> Tensor:
    return _rotation(draw.direction(), draw.uniform(0, largest))


def _rotation(axis: Tensor, degrees: float) -> Tensor:
    return so3_exp(math.radians(degrees) * axis)
