"""Depth pictures as frames: their points, what counts of them, and where they say that nothing is."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import se3_exp
from torchreg.io.calibration import save_depth_camera
from torchreg.io.images import save_depth, save_image

FormatError, InputError, InputTypeError = tr.errors.FormatError, tr.errors.InputError, tr.errors.InputTypeError

MOTION = se3_exp(torch.tensor([0.1, -0.2, 0.1, 0.2, -0.4, 0.1], dtype=torch.float64))
LENS = (-0.1, 0.03, 1e-3, -2e-3)
CAMERA = tr.Camera(64, 48, (60.0, 66.0, 31.0, 24.5), MOTION)
BENT = tr.Camera(64, 48, (60.0, 66.0, 31.0, 24.5), MOTION, LENS)


def wall_with_box():
    """Depths of a wall at 2 m and a box of 24 x 16 pixels at 1 m before it, and the box's mask."""
    depth = torch.full((48, 64), 2.0, dtype=torch.float64)
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[16:32, 20:44] = True
    return torch.where(mask, 1.0, depth), mask


def at_pixels(camera, column, row, depth):
    pixels = torch.tensor([column, row], dtype=torch.float64).T
    return camera.unproject(pixels, torch.as_tensor(depth, dtype=torch.float64))


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "lens"])
def test_points_project_to_their_pixels_at_their_depths(camera):
    depth, mask = wall_with_box()
    frame = tr.DepthFrame(depth, camera, mask)
    pixels, found = camera.project(frame.points)
    torch.testing.assert_close(pixels, frame.pixels.double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(found, torch.ones_like(found))
    assert len(frame.points) == int(mask.sum())


def test_many_pixels_are_thinned_to_a_grid():
    depth, mask = wall_with_box()
    frame = tr.DepthFrame(depth, CAMERA, mask, max_points=100)
    assert frame.stride == 2
    assert len(frame.points) == 12 * 8
    assert bool((frame.pixels % 2 == 0).all())


def test_what_was_not_measured_and_flying_pixels_are_no_points():
    depth, mask = wall_with_box()
    depth[16, 20:44] = 1.5  # between box and wall
    depth[20, 20], depth[20, 21], depth[20, 22] = math.nan, -1.0, math.inf
    frame = tr.DepthFrame(depth, CAMERA, mask)
    assert len(frame.points) == int(mask.sum()) - 24 - 3
    assert int(frame.pixels[:, 1].min()) == 17


def test_normals_face_the_camera():
    depth, mask = wall_with_box()
    normals = tr.DepthFrame(depth, CAMERA, mask).normals
    torch.testing.assert_close(normals, -MOTION[2, :3].expand_as(normals), atol=1e-6, rtol=0)


def test_a_crop_keeps_what_both_masks_keep():
    depth, mask = wall_with_box()
    left = torch.zeros_like(mask)
    left[:, :30] = True
    both = tr.DepthFrame(depth, CAMERA, mask).cropped(left)
    assert torch.equal(both.mask, mask & left)
    assert repr(both) == "DepthFrame(64 x 48 pixels, 160 of them count)"


def test_intrusions_are_those_of_a_box_before_a_wall():
    depth, mask = wall_with_box()
    space = tr.DepthFrame(depth, CAMERA, mask).free_space
    columns, rows = [30.0, 30.0, 30.0, 50.0, 50.0, 21.0, 70.0], [20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0]
    depths = [0.9, 1.1, 1.0, 0.8, 2.5, 0.7, 1.0]
    points = at_pixels(CAMERA, columns, rows, depths)
    scale = 0.8 / math.sqrt(60 * 66)
    # Before the box, behind it, on it; 6.5 pixels beside the mask; hidden by the wall; before the box; off the picture.
    expected = [0.1, 0.0, 0.0, 6.5 * scale, 0.0, 0.3, 0.0]
    torch.testing.assert_close(space.intrusion(points[None])[0], points.new_tensor(expected))


def test_nothing_is_known_behind_the_camera_and_in_holes():
    depth, mask = wall_with_box()
    depth[20, 30] = 0.0
    space = tr.DepthFrame(depth, CAMERA, mask).free_space
    behind = torch.linalg.solve(MOTION, depth.new_tensor([0.0, 0.0, -1.0, 1.0]))[None, :3]
    points = torch.cat([behind, at_pixels(CAMERA, [30.0], [20.0], [0.5])])
    assert space.intrusion(points[None]).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "lens"])
def test_the_gradient_is_that_of_finite_differences(camera):
    depth, mask = wall_with_box()
    mask[20:28, 44:50] = True  # an outline with corners
    space = tr.DepthFrame(depth, camera, mask).free_space.moved(torch.tensor([0.3, -0.1, 0.2]))
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(200, 2, generator=generator, dtype=torch.float64) * torch.tensor([63.0, 47.0])
    depths = 0.5 + 0.45 * torch.rand(200, generator=generator, dtype=torch.float64)
    points = camera.unproject(pixels, depths) - space.origin
    intrusion, slope = space.intrusion_gradient(points[None])
    torch.testing.assert_close(intrusion, space.intrusion(points[None]))
    few = space.intruding(points[None], 0.01)
    assert few[0].tolist() == (intrusion[0] > 0.01).nonzero()[:, 0].tolist()
    torch.testing.assert_close(few[1:], (intrusion[:, few[0]], slope[:, few[0]]))
    step = 1e-7 * torch.eye(3, dtype=torch.float64)
    ahead, back = (space.intrusion((points.unsqueeze(1) + sign * step).reshape(1, -1, 3)) for sign in (1, -1))
    numeric = ((ahead - back) / 2e-7).reshape(200, 3)
    close = (numeric - slope[0]).abs().amax(-1) < 1e-5
    assert int((intrusion > 0).sum()) > 150
    # A step may cross the border of two pixels, where the nearest depth jumps.
    assert float(close.double().mean()) > 0.98


def test_several_pictures_of_any_size_are_those_alone():
    depth, mask = wall_with_box()
    small = tr.Camera(40, 40, (50.0, 50.0, 20.0, 20.0))
    frames = [
        tr.DepthFrame(depth, CAMERA, mask),
        tr.DepthFrame(depth[:40, :40], small, mask[:40, :40]),
        tr.DepthFrame(depth, BENT),
    ]
    together = type(frames[0].free_space).stacked([frame.free_space for frame in frames])
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 300, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 1.5])
    alone = [frame.free_space.intrusion(part[None])[0] for frame, part in zip(frames, points, strict=True)]
    torch.testing.assert_close(together.intrusion(points), torch.stack(alone))
    again = together.rows(torch.tensor([2, 0]))
    torch.testing.assert_close(again.intrusion(points[[2, 0]]), torch.stack([alone[2], alone[0]]))


def test_files_make_a_frame(tmp_path):
    depth, mask = wall_with_box()
    save_depth(tmp_path / "d.png", depth)
    save_image(tmp_path / "m.png", mask.float())
    save_depth_camera(tmp_path / "k.json", CAMERA)
    frame = tr.DepthFrame.load(tmp_path / "d.png", tmp_path / "k.json", tmp_path / "m.png", farthest=1.5)
    torch.testing.assert_close(frame.points, tr.DepthFrame(depth, CAMERA, mask).points.float())
    save_image(tmp_path / "n.png", mask[1:].float())
    with pytest.raises(FormatError, match=r"n\.png: mask must have shape \(48, 64\), got \(47, 64\)"):
        tr.DepthFrame.load(tmp_path / "d.png", tmp_path / "k.json", tmp_path / "n.png")
    with pytest.raises(FormatError, match=r"d\.png: depth must be positive .* got 0 of 384 pixels of the mask"):
        tr.DepthFrame.load(tmp_path / "d.png", tmp_path / "k.json", tmp_path / "m.png", farthest=0.5)
    save_depth_camera(tmp_path / "other.json", tr.Camera(32, 24, (30.0, 30.0, 15.5, 11.5)))
    with pytest.raises(FormatError, match=r"d\.png.* is 64 x 48 pixels, the camera's pictures are 32 x 24"):
        tr.DepthFrame.load(tmp_path / "d.png", tmp_path / "other.json")


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"depth": torch.ones(48, 63)}, InputError, r"depth must have shape \(48, 64\), got \(48, 63\)"),
        ({"depth": torch.zeros(48, 64)}, InputError, "got 0 of 384 pixels of the mask measured"),
        ({"depth": torch.full((48, 64), torch.nan)}, InputError, "got 0 of 384 pixels of the mask measured"),
        ({"depth": torch.full((48, 64), 570.0)}, InputError, "must be in metres, got 570 in the middle; multiply"),
        ({"camera": "k.json"}, InputTypeError, "camera must be a Camera, got str"),
        ({"mask": torch.ones(48, 64)}, InputTypeError, "mask must hold bool"),
        ({"mask": torch.ones(48, 60, dtype=torch.bool)}, InputError, r"mask must have shape \(48, 64\)"),
        ({"max_points": 2}, InputError, "max_points must be"),
    ],
)
def test_bad_input_is_told(change, kind, message):
    depth, mask = wall_with_box()
    with pytest.raises(kind, match=message):
        tr.DepthFrame(**{"depth": depth, "camera": CAMERA, "mask": mask, **change})
