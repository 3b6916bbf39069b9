import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import camera_ring
from torchreg.viz import seen

CAMERA = tr.Camera.looking_at([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], focal=60.0, width=48, height=40)


@pytest.fixture
def small_ball(tools):
    """Return the function that makes a ball of radius 0.1 around a center."""
    mesh = tools.ball(3, torch.float64)
    return lambda center: tr.TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor(center), mesh.faces)


def test_ramp_goes_from_dark_blue_to_orange():
    colors = seen.depth_colors(torch.tensor([1.0, 2.0, 9.0, torch.nan]), 1.0, 3.0)
    assert colors[0, 2] > colors[0, 0]
    assert colors[2, 0] > 0.9
    assert torch.equal(colors[3], torch.zeros(3))
    assert torch.equal(seen.depth_colors(torch.tensor([3.0]), 1.0, 3.0)[0], colors[2])


def test_points_are_squares_and_inliers_hide_others():
    pixels = torch.tensor([[10.0, 5.0], [11.0, 5.0], [-1.0, 0.0], [torch.nan, 1.0]])
    drawn = seen.picture_with_points(torch.zeros(12, 20), pixels, torch.tensor([True, False, True, True]))
    assert drawn.shape == (12, 20, 3)
    blue, red = drawn[5, 9], drawn[5, 12]
    assert (drawn[4:7, 9:12] == blue).all()
    assert (drawn[4:7, 12] == red).all()
    assert blue[2] > blue[0]
    assert red[0] > red[2]
    assert torch.equal(drawn[0, 0], blue)  # half beside the picture
    assert torch.allclose(drawn[11], torch.full((20, 3), 0.4))


def test_outline_of_a_ball_runs_around_its_mask(small_ball):
    ball = small_ball([0.0, 0.0, 0.5])
    mask = seen.model_mask(ball, CAMERA)
    outline = seen.mask_outline(mask)
    assert 0 < outline.sum() < mask.sum()
    assert (outline & ~mask).sum() == 0
    assert not outline[20, 24]
    drawn = seen.picture_with_points(
        torch.zeros(40, 48, 3), torch.zeros(0, 2), torch.zeros(0, dtype=torch.bool), outline
    )
    assert torch.equal((drawn[..., 1] == 1.0), outline)
    behind = tr.TriangleMesh(-ball.vertices, ball.faces)
    assert not seen.model_mask(behind, CAMERA).any()


def test_cut_and_hull_pictures_distinguish_pixels():
    depth = torch.tensor([[0.0, 1.0, 2.0], [1.0, 1.5, 2.0]])
    kept = torch.tensor([[False, True, False], [True, True, True]])
    colors = seen.cut_picture(depth, kept)
    assert torch.equal(colors[0, 0], torch.zeros(3))
    assert colors[0, 2, 0] == 1.0
    assert torch.equal(colors[0, 1], colors[1, 0])
    assert not torch.equal(colors[0, 1], colors[1, 2])
    mask, hull = torch.tensor([[True, True, False, False]]), torch.tensor([[True, False, True, False]])
    row = seen.hull_picture(mask, hull)[0]
    assert len({tuple(color.tolist()) for color in row}) == 4
    assert torch.equal(row[3], torch.zeros(3))


def test_model_mask_follows_the_lens(small_ball):
    ball = small_ball([0.1, 0.05, 0.5])
    lens = tr.Camera(48, 40, [60.0, 55.0, 23.5, 19.5], distortion=(-0.3, 0.1, 0.0, 0.0))
    mask = seen.model_mask(ball, lens)
    rays = lens.directions(lens.pixel_grid())
    center = rays.new_tensor([0.1, 0.05, 0.5])
    exact = (rays @ center) ** 2 > (rays**2).sum(-1) * ((center**2).sum() - 0.01)
    assert exact.sum() > 100
    assert (mask ^ exact).sum() < 0.1 * exact.sum()


def test_sheet_holds_the_picture_of_every_camera(small_ball):
    ball = small_ball([0.0, 0.0, 0.0])
    ring = camera_ring([0.0, 0.0, 0.0], 0.6, 3, focal=60.0, width=48, height=40)
    masks = [seen.model_mask(ball, camera) for camera in ring]
    sheet = seen.hull_sheet(masks, ring, ball, width=48)
    assert sheet.shape == (84, 100, 3)
    assert torch.equal(sheet[1:41, 1:49], seen.hull_picture(masks[0], masks[0]))
    assert not sheet[42:, 50:].any()
    assert seen.hull_sheet(masks, ring, ball, width=24).shape == (44, 52, 3)
