"""What else may explain a picture: surfaces that go on past the shape, and flat faces."""

from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from torchreg.alignment.evidence.picture_agreement import planes_instead
from torchreg.capture.depth_segments import open_rim

CAMERA = tr.Camera(64, 48, (80.0, 80.0, 31.5, 23.5))


def disk(radius=12.0):
    """A mask (H, W) of pixels around the middle of the picture."""
    row, column = torch.meshgrid(torch.arange(48) - 23.5, torch.arange(64) - 31.5, indexing="ij")
    return row.hypot(column) < radius


def on_pixels(mask):
    """Which points lie on pixels of a mask, a metre away."""

    def lies_on(points):
        column, row = CAMERA.project(points)[0].round().long().unbind(-1)
        return mask[row, column] & (points[:, 2] < 1.2)

    return lies_on


@pytest.mark.parametrize(("background", "radius", "hole", "share"), [
    (1.0, 11.0, False, 1.0), (1.5, 13.0, False, 0.0), (0.0, 13.0, False, 0.0), (1.5, 13.0, True, 0.0),
])  # fmt: skip
def test_the_rim_is_open_where_the_surface_goes_on(background, radius, hole, share):
    """Pixels that measured nothing are no rim."""
    depth = torch.where(disk(), 1.0, background).double()
    if hole:
        depth[20:28:4, 26:38:4] = 0.0
    assert open_rim(tr.DepthFrame(depth, CAMERA), on_pixels(disk(radius))) == share


def test_the_rim_is_open_by_its_share_whatever_the_mask_leaves_out():
    depth = torch.where(disk() | (torch.arange(48) > 24)[:, None], 1.0, 2.0).double()
    frame = tr.DepthFrame(depth, CAMERA)
    shares = [open_rim(each, on_pixels(disk())) for each in (frame, frame.cropped(disk()))]
    assert 0.3 < shares[0] < 0.7
    assert shares[1] == pytest.approx(shares[0], abs=0.1)


def test_planes_explain_a_box_better_than_a_shape_that_errs_but_no_ball():
    generator = torch.Generator().manual_seed(3)
    side = torch.rand(300, 2, 3, generator=generator, dtype=torch.float64) - 0.5
    side[:, 0, 0], side[:, 1, 1] = 0.5, 0.5
    unit = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator, dtype=torch.float64), dim=-1)
    data = 0.2 * torch.stack([side.flatten(0, 1), 0.5 * unit])
    problem = SimpleNamespace(data=data, valid=torch.ones(2, 600, dtype=torch.bool), size=0.3)
    off = 0.002 * torch.randn(2, 600, generator=generator, dtype=torch.float64)
    box, ball = planes_instead(problem, off).tolist()
    assert box > 0.8
    assert ball == 0
    exact = planes_instead(problem, 0 * off)
    assert exact.tolist() == [0, 0]  # a shape that is right is not beaten
    turned = problem.data @ torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0].mT
    again = planes_instead(SimpleNamespace(data=turned + 0.1, valid=problem.valid, size=0.3), off)
    assert again.tolist() == pytest.approx([box, ball], abs=0.02)
