"""What is no mesh, scan, depth image, camera, pair, rig, skeleton or view is refused with the reason."""

import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig, StereoPair
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh, sample_surface, unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.skeleton import Skeleton, build_skeleton
from torchreg.geometry.support import split_support
from torchreg.geometry.surface_graph import one_piece
from torchreg.geometry.visibility import aim, rasterize, sample_visible, view_rotation

EYE, ONES, NONE = torch.eye(3), torch.ones(9, 3), torch.zeros(0, 3, dtype=torch.int64)
BALL = unit_sphere(1)
PINHOLE = (100.0, 90.0, 20.0, 15.0)
BEFORE = torch.tensor([0.0, 0.0, -3.0])


def table(rows):
    return pytest.mark.parametrize(("make", "error", "words"), [pytest.param(*row, id=row[2][:30]) for row in rows])


def mesh(vertices=EYE, faces=((0, 1, 2),)):
    return TriangleMesh(vertices, faces if isinstance(faces, str) else torch.as_tensor(faces))


def scan(*values, **options):
    return RangeScan(*values, **options)


def depth(*values, **options):
    return RangeScan.from_depth(*values, **options)


def camera(**change):
    return Camera(**{"width": 4, "height": 4, "intrinsics": (2.0, 2.0, 1.5, 1.5)} | change)


def at(x, turn=0.0):
    motion = torch.eye(4)
    motion[0, 0] = motion[2, 2] = math.cos(turn)
    motion[0, 2], motion[2, 0] = math.sin(turn), -math.sin(turn)
    motion[0, 3] = -x * math.cos(turn)
    motion[2, 3] = x * math.sin(turn)
    return camera(world_to_camera=motion)


def skeleton(edges=((0, 1), (1, 2)), nodes=EYE, radii=(1.0, 1.0, 1.0), *more, **options):
    return Skeleton(nodes, edges, radii, *more, **options)


def diagonal(*values):
    return torch.diag(torch.tensor([*values, 1.0]))


@table([
    (lambda: mesh(torch.zeros(3, 2)), InputError, r"vertices must have shape \(V, 3\), got \(3, 2\)"),
    (lambda: mesh(torch.full((3, 3), math.nan)), InputError, "vertices must be finite, got 9 non-finite of 9"),
    (lambda: mesh(faces=[[0, 1, 3]]), InputError, r"index the 3 vertices \(0 to 2\), got indices from 0 to 3"),
    (lambda: mesh(faces=[[0, -1, 2]]), InputError, "from -1 to 2"),
    (lambda: mesh(faces=[[0, 1]]), InputError, r"faces must have shape \(F, 3\)"),
    (lambda: mesh(faces=[[0.0, 1.0, 2.0]]), InputTypeError, "faces must hold integers"),
    (lambda: mesh(faces="none"), InputTypeError, "faces must be an"),
    (lambda: BALL.vertex_normals("size"), InputError, "weighting must be one of angle, area"),
    (lambda: mesh(torch.zeros(0, 3), NONE).bounds(), InputError, "at least 1 point"),
    *((lambda n=n: unit_sphere(n), InputError, "subdivisions must be an integer") for n in (-1, 9, 1.5, True)),
    (lambda: sample_surface(mesh(0 * EYE), 5), InputError, "mesh must have a surface to sample"),
    (lambda: sample_surface(mesh(faces=NONE), 5), InputError, "mesh must have a surface to sample"),
    (lambda: one_piece(mesh(0 * EYE)), InputError, "three different corners"),
    (lambda: one_piece(mesh(torch.arange(9.0).reshape(3, 3))), InputError, "without area"),
    (lambda: isosurface(lambda p: p[:, 0], -ONES[0], ONES[0], 1e-3), InputError, "choose a larger one"),
    (lambda: split_support(torch.zeros(0, 3)), InputError, "data must"),
    (lambda: split_support(ONES * torch.nan), InputError, "data must"),
])  # fmt: skip
def test_what_is_no_surface(make, error, words):
    with pytest.raises(error, match=words):
        make()


@table([
    (lambda: scan(torch.zeros(0, 3)), InputError, "points must hold at least 3 point"),
    (lambda: scan(EYE[:2]), InputError, "points must hold at least 3 point"),
    (lambda: scan(ONES), InputError, "points must lie at 3 places or more, got 9 points at 1"),
    (lambda: scan(ONES[:, :2]), InputError, r"points must have shape \(N, 3\), got \(9, 2\)"),
    (lambda: scan(EYE / 0), InputError, "points must be finite, got 9 non-finite of 9 numbers; drop those points"),
    (lambda: scan(EYE, torch.tensor([[0, 1, -1]])), InputError, "got indices from -1 to 1"),
    (lambda: scan(EYE, EYE), InputTypeError, "faces must hold integers"),
    (lambda: scan(EYE, None, EYE[:2]), InputError, r"normals must have shape \(3, 3\)"),
    (lambda: scan(EYE, None, EYE * torch.nan), InputError, "pass normals=None to have them estimated"),
    (lambda: scan("abc"), InputTypeError, "points must be a tensor or an array of numbers"),
    (lambda: scan(EYE.half()), InputTypeError, "points must be float32 or float64"),
    (lambda: scan(EYE.bfloat16()), InputTypeError, "points must be float32 or float64"),
    (lambda: scan(EYE).to(torch.float16), InputTypeError, "points must be float32 or float64"),
    (lambda: scan(EYE, viewpoint=[0.0, 1.0]), InputError, "viewpoint must have shape"),
    (lambda: scan(EYE).uniform_subsample(), InputError, "give either count or spacing"),
    (lambda: scan(EYE).uniform_subsample(3, spacing=1.0), InputError, "give either count or spacing"),
    (lambda: scan(EYE).uniform_subsample(spacing=0.0), InputError, "spacing must be positive"),
    (lambda: scan(EYE).subset(torch.ones(7, dtype=torch.bool)), InputError, "which must have shape"),
    (lambda: scan(EYE).subset(torch.tensor([0, 1, 3])), InputError, "which must index the 3 points .0 to 2.*0 to 3"),
    (lambda: scan(EYE).subset(torch.tensor([0, 1, 2, 1])), InputError, "every index once, got 1 repeated"),
    (lambda: scan(EYE).subset(torch.tensor([0.0, 1, 2])), InputTypeError, "which must hold bool or integers"),
    (lambda: scan(EYE).subset([]), InputError, "at least 3"),
    *(
        (lambda m=m: scan(EYE).transformed(m), InputError, "motion must be a rotation, a scale and a translation")
        for m in (
            diagonal(1, 1, -1), diagonal(1, 1, 2), diagonal(1, 1, 0), torch.zeros(4, 4),
            torch.eye(4) + 0.1 * torch.eye(4).roll(1, 0), torch.eye(4) + 0.1 * torch.eye(4)[3].outer(torch.eye(4)[2]),
        )
    ),
    (lambda: depth(torch.ones(5, 5), PINHOLE, max_jump=0.0), InputError, "max_jump must be positive"),
    (lambda: depth(torch.ones(5, 5), PINHOLE, diagonal(2, 2, 2)), InputError, "a rigid motion, got one that scales"),
    (lambda: depth(torch.ones(5, 5), PINHOLE, EYE), InputError, r"camera_to_world must have shape \(4, 4\)"),
    (lambda: depth(torch.ones(3), PINHOLE), InputError, r"depth must have shape \(H, W\)"),
    (lambda: depth(torch.zeros(3, 3), PINHOLE), InputError, "0 of 9 pixels measured and none joined"),
    (lambda: depth(torch.ones(1, 9), PINHOLE), InputError, "9 of 9 pixels measured and none joined"),
    (lambda: depth(EYE, (1, 1, 1)), InputTypeError, "intrinsics must be the four numbers fx, fy, cx, cy"),
    (lambda: depth(EYE, (0.0, 1, 1, 1)), InputError, r"intrinsics\[0\] \(fx\) must be positive"),
    (lambda: depth(EYE, (1, -1, 1, 1)), InputError, r"intrinsics\[1\] \(fy\) must be positive"),
    (lambda: depth(EYE, (1, 1, math.nan, 1)), InputError, "intrinsics must be finite"),
])  # fmt: skip
def test_what_is_no_scan(make, error, words):
    with pytest.raises(error, match=words):
        make()


@table([
    (lambda: camera(width=0), InputError, "width must be at least 1"),
    (lambda: camera(width=10_000, height=10_000), InputError, "at most 64 megapixels"),
    (lambda: camera(intrinsics=(1.0, 1.0, 1.0)), InputError, r"intrinsics must have shape \(4\)"),
    (lambda: camera(intrinsics=(1.0, -1.0, 1.0, 1.0)), InputError, r"intrinsics \(fy\) must be positive"),
    (lambda: camera(intrinsics=(1.0, math.nan, 1.0, 1.0)), InputError, "must be finite"),
    (lambda: camera(intrinsics=("a", 1.0, 1.0, 1.0)), InputError, "must hold numbers"),
    (lambda: camera(distortion=(0.1,)), InputError, "0, 4, 5 or 8 numbers"),
    (lambda: camera(world_to_camera=2 * torch.eye(4)), InputError, "must be a rotation and a translation"),
    (lambda: camera(world_to_camera=1.01 * torch.eye(4)), InputError, "must be a rotation and a translation"),
    (lambda: camera(world_to_camera=diagonal(1, 1, -1)), InputError, "must be a rotation and a translation"),
    (lambda: camera(world_to_camera=EYE), InputError, r"world_to_camera must have shape \(4, 4\)"),
    (lambda: camera().scaled(1e-4), InputError, "must leave a pixel"),
    (lambda: camera(distortion=(0.1, 0, 0, 0)).view(), InputError, "square pixels and no distortion"),
    (lambda: StereoPair(at(0.06), at(-0.06)), InputError, r"swapped: the right camera stands 0\.12 to the left"),
    (lambda: StereoPair(at(0.0), at(0.0)), InputError, "different places"),
    (lambda: StereoPair(at(0.0), at(0.1, 2.0)), InputError, "look the same way"),
    (lambda: CameraRig((at(0.0), at(0.1)))["top"], InputError, "no camera 'top', it has camera0, camera1"),
    (lambda: CameraRig((at(0.0),)).stereo(), InputError, "two cameras"),
    (lambda: CameraRig((camera(name="left"),) * 2), InputError, "left more than once"),
    (lambda: CameraRig(()), InputError, "at least one"),
    (lambda: CameraRig((1,)), InputTypeError, "Camera records"),
    (lambda: view_rotation(ONES[0], ONES[0]), InputError, "camera must lie away from the target"),
    (lambda: aim(BALL.vertices, EYE[0] / 2), InputError, "camera must have all of the points before it"),
    (lambda: aim(BALL.vertices, torch.zeros(2)), InputError, r"camera must have shape \(3\)"),
    (lambda: aim(BALL.vertices, BEFORE * torch.nan), InputError, "camera must be finite"),
    *((lambda s=s: aim(EYE, BEFORE, size=s), InputError, "size must be 1 to") for s in (0, (10, 20, 30), (9, 10**5))),
    (lambda: rasterize(mesh(EYE - 9), aim(EYE, BEFORE)), InputError, "mesh must lie before the camera, got 1 face"),
    (lambda: sample_visible(mesh(EYE), -9 * ONES[0], 5), InputError, "turn a face to the camera"),
])  # fmt: skip
def test_what_is_no_camera_or_view(make, error, words):
    with pytest.raises(error, match=words):
        make()


@table([
    (lambda: skeleton([(0, 1), (1, 2), (2, 0)]), InputError, "one tree"),
    (lambda: skeleton([(0, 1)]), InputError, "one tree"),
    (lambda: skeleton([(0, 1), (1, 0)]), InputError, "reach 2 of 3 nodes"),
    (lambda: skeleton([(0, 1), (1, 3)]), InputError, "must index the 3 nodes"),
    (lambda: skeleton([(0, 1, 2)]), InputError, "shape"),
    (lambda: skeleton(torch.zeros(2, 2)), InputTypeError, "edges must hold integers"),
    (lambda: skeleton(nodes=EYE * torch.nan), InputError, "nodes must be finite"),
    (lambda: skeleton(radii=torch.ones(4)), InputError, "radii must have shape"),
    (lambda: skeleton(((0, 1), (1, 2)), EYE, ONES[0], -EYE.expand(3, 3, 3)), InputError, "frames must be rotations"),
    (lambda: skeleton(confidence=torch.ones(3)), InputError, "confidence must have shape"),
    (lambda: skeleton().resample(1), InputError, "count must be at least 2"),
    (lambda: skeleton([], EYE[:1], torch.ones(1)).resample(3), InputError, "single node"),
    (lambda: skeleton([], EYE[:1], torch.ones(1)).limb_of(EYE), InputError, "must have a limb"),
    (lambda: skeleton().path(0, 8), InputError, "end must be a node from 0 to 2, got 8"),
    (
        lambda: build_skeleton([(EYE, ONES[0], EYE.expand(3, 3, 3))] * 2, [(0, 1), (1, 0)]),
        InputError, "one tree",
    ),
])  # fmt: skip
def test_what_is_no_skeleton(make, error, words):
    with pytest.raises(error, match=words):
        make()
