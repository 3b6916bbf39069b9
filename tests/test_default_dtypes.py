"""Every public function gives results in the dtype of its data, the same ones whatever torch's default dtype is."""

import math
from functools import cache

import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import camera_ring, render, stereo_cameras
from torchreg.capture.depth import depth_scan
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import unit_sphere
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.shapes.primitives import Primitive

QUICK = tr.RegisterConfig(align=ScanAlignConfig(num_samples=200), num_samples=300)
SEARCH = tr.FindPoseConfig(num_candidates=8, num_placed=4, num_searched=2, search_rounds=1, num_model_points=120)
FLOATS = (torch.float32, torch.float64)


@pytest.fixture(autouse=True)
def default_dtype():
    before = torch.get_default_dtype()
    yield
    torch.set_default_dtype(before)


@cache
def hand_cloud():
    hand = tr.Hand()
    pose = random_hand_pose(hand, torch.Generator().manual_seed(0))
    return make_hand_cloud(hand, pose, num_points=200, camera=torch.zeros(3)).points, pose


@cache
def finger_cloud():
    shape = finger(torch.float32)
    return tr.sample_skin(shape, 150)(shape.rest_pose() + 0.03).detach()


@cache
def toy_scans():
    toy = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=400), step=math.radians(12))
    return [(toy[frame].points, toy[frame].normals) for frame in range(2)]


@cache
def star():
    return creature_sequence(STARFISH, 2, resolution=24).meshes


@cache
def stereo_views():
    pair = stereo_cameras(width=120, height=90, focal=150.0)
    mesh = unit_sphere(3, dtype=torch.float64)
    mesh = tr.TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([0.0, 0.0, 0.6]), mesh.faces)
    return pair, [
        render(mesh, camera, generator=torch.Generator().manual_seed(0)) for camera in (pair.left, pair.right)
    ]


@cache
def silhouettes():
    cameras = camera_ring(torch.zeros(3), 4.0, 6, focal=100.0, width=80, height=80)
    return cameras, [render(unit_sphere(2, dtype=torch.float64), camera).mask for camera in cameras.cameras]


def finger(dtype):
    """A body with a hinge, cheap to search."""
    eye = torch.eye(4, dtype=torch.float64)
    knuckle = eye.clone()
    knuckle[2, 3] = 0.05
    tree = KinematicTree((
        Joint("body", -1, eye), Joint("finger", 0, knuckle, "revolute", (0.8, 0.6, 0.0), -0.5, 1.2)
    ))  # fmt: skip
    solids = [Primitive("ellipsoid", (0.05, 0.03, 0.06), eye), Primitive("ellipsoid", (0.012, 0.015, 0.04), eye)]
    return tr.ArticulatedShape(tree, ["body", "finger"], solids, nu=0.004, dtype=dtype)


def scans(dtype):
    return [tr.RangeScan(points.to(dtype), normals=normals.to(dtype)) for points, normals in toy_scans()]


def align(dtype):
    cloud, pose = hand_cloud()
    hand = tr.Hand(dtype=dtype)
    # Searches are those of `find_pose` below.
    config = tr.AlignConfig(search="never")
    found = tr.align(hand, cloud.to(dtype), initial_pose=pose.to(dtype) + 0.02, config=config)
    return [found.pose, found.keypoints, found.distances, found.posterior, found.cost, found.sigma]


def find_pose(dtype):
    found = tr.find_pose(finger(dtype), finger_cloud().to(dtype), config=SEARCH)
    return [found.poses, found.costs, found.confidence]


def track(dtype):
    shape, cloud = finger(dtype), finger_cloud().to(dtype)
    found = tr.Tracker(shape, shape.rest_pose()).run([cloud, cloud + 0.002])
    return [found.poses, found.keypoints]


def calibrate(dtype):
    shape, cloud = finger(dtype), finger_cloud().to(dtype)
    found = tr.calibrate(shape, [cloud, cloud + 0.002], shape.rest_pose().repeat(2, 1))
    return [found.poses, found.log_length_scales]


def initialize(dtype):
    shape, cloud = finger(dtype), finger_cloud().to(dtype)
    layer = tr.PoseInitializer(shape, tr.PoseInitializerConfig(find_pose=SEARCH))
    start = shape.rest_pose() + 0.01
    return [layer(cloud[None]).pose, layer(cloud[None], start=start[None]).pose]


def losses(dtype):
    cloud, pose = hand_cloud()
    hand = tr.Hand(dtype=dtype)
    skin = tr.BendingSkin(hand, cloud[:40].to(dtype), pose.to(dtype))
    moved = skin(pose.to(dtype))
    loss = tr.EMLoss(0.01)(moved, cloud.to(dtype))
    return [moved, loss, hand.keypoints(pose.to(dtype)), hand.distance(cloud.to(dtype), pose.to(dtype))]


def register(dtype):
    first, second = scans(dtype)
    pair = tr.register(first, second, 4, 16, QUICK)
    solved = tr.solve_pose(pair.model, pair.points[::50], pair.deformed[::50])
    many = tr.register_sequence([first, second], 4, 16, QUICK)
    return [pair.deformed, pair.weights, pair.transforms, solved.transforms, many.deformed]


def spine(dtype):
    meshes = [tr.TriangleMesh(mesh.vertices.to(dtype), mesh.faces) for mesh in star()]
    found = tr.extract_spine(meshes, workers=1)
    return [found.curves, found.radii, tr.skeletonize(meshes[0]).nodes, found.model(0.5)]


def stereo(dtype):
    pair, (left, right) = stereo_views()
    found = tr.stereo_points(left.image.to(dtype), right.image.to(dtype), pair)
    scan = depth_scan(left.depth.to(dtype), pair.left)
    return [found.points, scan.points, scan.normals, tr.fuse_scans([scan, scan], 0.02).points]


def hull(dtype):
    cameras, masks = silhouettes()
    return [tr.visual_hull(masks, cameras, resolution=24).mesh().vertices.to(dtype)]


CALLS = (
    align, find_pose, track, calibrate, initialize, losses, register, spine, stereo, hull
)  # fmt: skip


def outputs(call, dtype, default):
    torch.set_default_dtype(torch.float32)
    hand_cloud(), finger_cloud(), toy_scans(), star(), stereo_views(), silhouettes()
    torch.set_default_dtype(default)
    return call(dtype)


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
def test_results_have_the_dtype_of_the_data_whatever_the_default(call):
    plain, other = (outputs(call, torch.float32, default) for default in FLOATS)
    for first, second in zip(plain, other, strict=True):
        assert first.dtype == second.dtype == torch.float32
        assert bool(first.isfinite().all())
        torch.testing.assert_close(first, second, rtol=1e-2, atol=1e-3)
    assert {output.dtype for output in outputs(call, torch.float64, torch.float32)} == {torch.float64}
