"""What all public functions keep to, whatever the world that their data come from: a table of functions by contracts.

Far from the origin, turned and in other units the same is found; float64 stays float64 and float32 stays float32,
whatever torch's default is; the same call gives the same numbers and leaves the global generator alone; a batch is a
loop over its entries, and what is masked might as well not be there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import camera_ring, render, stereo_cameras
from tests.bodies import QUICK, bent_tube, finger
from torchreg import metrics
from torchreg.alignment.pseudo_labels import label_frames
from torchreg.datasets import creatures
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rotation import so3_exp

D = torch.float64
SEARCH = tr.FindPoseConfig(num_candidates=4, num_placed=2, num_searched=1, search_rounds=1, num_model_points=60)
DESCENT = tr.AlignConfig(search="never")


@dataclass(frozen=True)
class World:
    """Where data lie: turned about the origin, scaled, then shifted; and their dtype."""

    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector
    unit: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dtype: torch.dtype = D

    def points(self, points):
        moved = self.unit * (points.to(D) @ so3_exp(torch.tensor(self.turn, dtype=D)).mT)
        return (moved + torch.tensor(self.shift, dtype=D)).to(self.dtype)

    def mesh(self, points, faces):
        return tr.TriangleMesh(self.points(points), faces)

    def scan(self, points, faces):
        return tr.RangeScan(self.points(points), faces)

    def pose(self, pose):
        """The pose of a shape that is not turned, in this world."""
        turn = torch.tensor(self.turn, dtype=self.dtype)
        return torch.cat([self.points(pose[..., :3]), turn.expand_as(pose[..., 3:6]), pose[..., 6:].to(self.dtype)], -1)

    def camera(self, camera):
        motion = torch.eye(4, dtype=D)
        motion[:3, :3], motion[:3, 3] = so3_exp(torch.tensor(self.turn, dtype=D)), torch.tensor(self.shift, dtype=D)
        return camera.moved(motion)

    def back(self, name, values):
        """What was found in this world, as it would be in the plain one."""
        if name in ("points", "directions"):
            moved = values.to(D) - (torch.tensor(self.shift, dtype=D) if name == "points" else 0.0)
            values = moved @ so3_exp(torch.tensor(self.turn, dtype=D))
        return values.to(D) / (self.unit if name in ("points", "lengths") else 1.0)


PLAIN = World()
WORLDS = {
    "far": World(shift=(1e6, -1e6, 2e6)),
    "turned": World(turn=(0.4, -1.1, 0.7)),
    "millimeters": World(unit=1000.0),
}


@dataclass(frozen=True)
class Row:
    """A function: what it finds in a world by kind, how exactly, and in which worlds it has a meaning."""

    call: Callable[[World], dict[str, list[torch.Tensor]]]
    atol: float = 1e-6  # of points and lengths
    plain: float = 1e-6
    worlds: tuple[str, ...] = tuple(WORLDS)


# Data


@cache
def cloud():
    """120 points of a finger and the pose of a start nearby."""
    shape = finger(D)
    pose = shape.rest_pose()
    pose[6:] = 0.3
    return tr.sample_skin(shape, 120)(pose).detach(), shape.rest_pose()


@cache
def tube(bend):
    return bent_tube(bend, 19, 7)


@cache
def star():
    return [
        (mesh.vertices.to(D), mesh.faces)
        for mesh in creatures.creature_sequence(creatures.STARFISH, 2, resolution=24).meshes
    ]


@cache
def views():
    pair = stereo_cameras(width=120, height=90, focal=150.0)
    mesh = unit_sphere(3, dtype=D)
    mesh = tr.TriangleMesh(0.1 * mesh.vertices + torch.tensor([0.0, 0.0, 0.6], dtype=D), mesh.faces)
    return pair, [render(mesh, each, generator=torch.Generator().manual_seed(0)) for each in (pair.left, pair.right)]


@cache
def outlines():
    cameras = camera_ring(torch.zeros(3), 4.0, 6, focal=100.0, width=80, height=80)
    return cameras.cameras, [render(unit_sphere(2, dtype=D), camera).mask for camera in cameras.cameras]


# Rows


def skins(world):
    data, pose = cloud()
    shape, posed = finger(world.dtype, world.unit), world.pose(pose)
    skin = tr.BendingSkin(shape, world.points(data[:40]), posed)
    moved = skin(posed + 0.02 * torch.eye(7, dtype=world.dtype)[6])
    return {
        "points": [moved, shape.keypoints(posed), shape(posed).points],
        "lengths": [shape.distance(world.points(data), posed)],
        "plain": [tr.EMLoss(0.01 * world.unit)(moved, world.points(data))],
    }


def align(world):
    data, pose = cloud()
    shape = finger(world.dtype, world.unit)
    skin = tr.BendingSkin(shape, world.points(data[::2]), world.pose(cloud()[1]))
    found = tr.align(shape, world.points(data), world.pose(pose), model_points=skin, config=DESCENT)
    return {
        "points": [found.pose[:3], found.keypoints, found.registered],
        "lengths": [found.distances, found.sigma],
        "plain": [found.pose[6:], found.posterior, found.inliers.to(world.dtype)],
    }


def find_pose(world):
    found = tr.find_pose(finger(world.dtype, world.unit), world.points(cloud()[0]), config=SEARCH)
    return {"points": [found.best[:3]], "plain": [found.best[6:], found.costs[..., 0], found.confidence]}


def track(world):
    shape, (data, pose) = finger(world.dtype, world.unit), cloud()
    found = tr.Tracker(shape, world.pose(pose)).run([world.points(data + 0.001 * k) for k in range(2)])
    return {"points": [found.poses[:, :3], found.keypoints], "plain": [found.poses[:, 6:]]}


def calibrate(world):
    shape, (data, pose) = finger(world.dtype, world.unit), cloud()
    found = tr.calibrate(shape, [world.points(data)], world.pose(pose)[None])
    return {"points": [found.poses[:, :3]], "plain": [found.poses[:, 6:], found.log_length_scales]}


def initialize(world):
    data, pose = cloud()
    layer = tr.PoseInitializer(finger(world.dtype, world.unit), tr.PoseInitializerConfig(find_pose=SEARCH))
    found = layer(world.points(data)[None], start=world.pose(pose)[None])
    return {"points": [found.pose[..., :3]], "plain": [found.pose[..., 6:], found.confidence]}


def label(world):
    data, pose = cloud()
    layer = tr.PoseInitializer(finger(world.dtype, world.unit))
    found = next(iter(label_frames(layer, [world.points(data)], start=world.pose(pose))))
    return {"points": [found.points, found.pose[:3]], "plain": [found.pose[6:]]}


def register(world):
    first, second = (world.scan(*tube(bend)) for bend in (0.0, 0.4))
    pair = tr.register(first, second, 2, 10, QUICK)
    solved = tr.solve_pose(pair.model, pair.points[::50], pair.deformed[::50])
    return {
        "points": [pair.deformed, pair.model(pair.points), pair.model(pair.points, solved.transforms)],
        "plain": [pair.weights],
    }


def register_sequence(world):
    scans = [world.scan(*tube(bend)) for bend in (0.0, 0.3)]
    return {"points": [tr.register_sequence(scans, 2, 10, QUICK).deformed]}


def scan(world):
    found = world.scan(*tube(0.4))
    return {
        "points": [found.points],
        "directions": [found.normals],
        "lengths": [torch.tensor(found.spacing, dtype=world.dtype)],
    }


def skeleton(world):
    found = tr.skeletonize(world.mesh(*star()[0]))
    return {"points": [found.nodes], "lengths": [found.radii], "plain": [found.confidence]}


def spine(world):
    found = tr.extract_spine([world.mesh(*mesh) for mesh in star()], workers=1)
    return {"points": [found.curves, found.model(0.5), found.model(found.times)], "lengths": [found.radii]}


def stereo(world):
    pair, (left, right) = views()
    found = tr.stereo_points(left.image.to(world.dtype), right.image.to(world.dtype), pair)
    one = tr.depth_scan(left.depth.to(world.dtype), pair.left)
    return {"points": [found.points, one.points, tr.fuse_scans([one, one], 0.02).points], "directions": [one.normals]}


def hull(world):
    cameras, masks = outlines()
    found = tr.visual_hull(masks, [world.camera(camera) for camera in cameras], resolution=24)
    return {"points": [found.mesh().vertices.mean(0).to(world.dtype)]}


def support(world):
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=D)
    table = points * torch.tensor([4.0, 4.0, 0.0]) - torch.tensor([2.0, 2.0, 0.0])
    box = points * torch.tensor([0.5, 0.5, 0.7])
    return {"plain": [tr.split_support(world.points(torch.cat([table, box]))).mask.to(world.dtype)]}


def distances(world):
    (first, _), (second, _) = tube(0.0), tube(0.4)
    first, second = world.points(first), world.points(second)
    return {
        "lengths": [
            metrics.chamfer(first, second),
            metrics.endpoint_error(first, second),
            metrics.keypoint_error(first, second),
        ],
        "plain": [metrics.pck(first, second, 0.1 * world.unit)],
    }


ROWS = {
    "skins": Row(skins),
    "align": Row(align, atol=2e-4, plain=1e-2),
    "find_pose": Row(find_pose, atol=1e-5),
    "track": Row(track, plain=1e-4),
    "calibrate": Row(calibrate, atol=1e-5, plain=5e-3, worlds=("far", "millimeters")),
    "initialize": Row(initialize),
    "label": Row(label),
    "register": Row(register, atol=1e-3, plain=5e-3),
    "register_sequence": Row(register_sequence, atol=1e-3, worlds=("far",)),  # the rest as `register`
    "scan": Row(scan),
    "skeleton": Row(skeleton, worlds=("far",)),  # the rest as `spine`
    "spine": Row(spine),
    "stereo": Row(stereo, worlds=()),
    "hull": Row(hull, atol=0.03, worlds=("turned",)),  # its grid is not turned
    "support": Row(support),
    "metrics": Row(distances),
}


@cache
def plain(name):
    return ROWS[name].call(PLAIN)


def check(row, world, found, expected, **tolerance):
    """Compare what was found in a world with what is in the plain one, each kind in its way."""
    for kind, values in expected.items():
        exact = {"atol": row.plain if kind == "plain" else row.atol, "rtol": row.atol} | tolerance
        for value, wanted in zip(found[kind], values, strict=True):
            assert value.dtype == world.dtype
            torch.testing.assert_close(world.back(kind, value), wanted, equal_nan=True, **exact)


@pytest.mark.parametrize(("name", "world"), [(name, world) for name, row in ROWS.items() for world in row.worlds])
def test_the_same_is_found_far_away_turned_and_in_other_units(name, world):
    check(ROWS[name], WORLDS[world], ROWS[name].call(WORLDS[world]), plain(name))


@pytest.mark.parametrize("name", ROWS)
def test_calls_repeat_and_leave_the_global_generator_alone(name):
    expected, state = plain(name), torch.manual_seed(7).get_state()
    found = ROWS[name].call(PLAIN)
    assert torch.equal(torch.get_rng_state(), state)
    check(ROWS[name], PLAIN, found, expected, atol=0, rtol=0)


@pytest.mark.parametrize("name", ROWS)
def test_single_precision_stays_single_whatever_the_default(name):
    expected, single = plain(name), World(dtype=torch.float32)
    torch.set_default_dtype(D)
    try:
        found = ROWS[name].call(single)
    finally:
        torch.set_default_dtype(torch.float32)
    check(ROWS[name], single, found, expected, atol=1e-3, rtol=1e-2)


# Batches and masks


@cache
def clouds():
    """Three clouds of a finger of different sizes, their starts, and the clouds padded with outliers and a mask."""
    shape = finger(D)
    poses = shape.rest_pose().repeat(3, 1)
    poses[:, 6], poses[1, 0], poses[2, 3] = torch.tensor([0.1, 0.5, 0.9], dtype=D), 0.02, 0.4
    every = [points[: 150 - 20 * k] for k, points in enumerate(tr.sample_skin(shape, 150)(poses).detach())]
    padded = torch.nn.utils.rnn.pad_sequence(every, batch_first=True, padding_value=0.07)
    return every, poses + 0.01, padded, torch.arange(150) < torch.tensor([[len(each)] for each in every])


@cache
def bent_model():
    first, second = (PLAIN.scan(*tube(bend)) for bend in (0.0, 0.4))
    return tr.register(first, second, 2, 10, QUICK)


def skinned(points, pose):
    """The model points of a finger of 40 points in a pose."""
    shape = finger(D)
    return tr.BendingSkin(shape, clouds()[0][0][:40], shape.rest_pose())(pose)


def aligned(points, mask, start):
    shape = finger(D)
    skin = tr.BendingSkin(shape, clouds()[0][0][::2], clouds()[1][0])
    return tr.align(shape, points, start, mask=mask, model_points=skin, config=DESCENT).keypoints


def solved(points, mask, start):
    pair = bent_model()
    handles = pair.points[:: len(pair.points) // 8][:8]
    config = tr.SolvePoseConfig(max_steps=4, rtol=0.0, atol=0.0)
    return tr.solve_pose(
        pair.model, handles, pair.model(handles).detach() + start[..., None, :3], config=config
    ).transforms


# Of points (..., N, 3), a mask (..., N) or None and poses (..., D).
BATCHES = {
    "align": aligned,
    "find_pose": lambda points, mask, start: tr.find_pose(finger(D), points, mask=mask, config=SEARCH).best,
    "initialize": lambda points, mask, start: tr.PoseInitializer(finger(D))(points, mask, start).pose,
    "em_loss": lambda points, mask, start: tr.EMLoss(0.01)(skinned(points, start), points, mask),
    "endpoint_error": lambda points, mask, start: metrics.endpoint_error(points, points + start[..., None, :3], mask),
    "pck": lambda points, mask, start: metrics.pck(points, points + start[..., None, :3], 0.02, mask),
    "chamfer": lambda points, mask, start: metrics.chamfer(points[..., :100, :], skinned(points, start)),
    "distance": lambda points, mask, start: finger(D).distance(points, start),
    "keypoints": lambda points, mask, start: finger(D).keypoints(start),
    "forward": lambda points, mask, start: finger(D)(start).points,
    "skin": lambda points, mask, start: skinned(points, start),
    "solve_pose": solved,
}


@pytest.mark.parametrize("name", BATCHES)
def test_a_batch_is_a_loop_and_what_is_masked_is_not_there(name):
    every, starts, padded, mask = clouds()
    together = BATCHES[name](padded, mask, starts)
    alone = BATCHES[name](every[-1], None, starts[-1])
    found = together[-1][: len(alone)] if alone.ndim else together[-1]
    torch.testing.assert_close(found, alone, atol=1e-5, rtol=1e-5)
