"""What stays in the pictures of a camera that stands still, and what moves before it."""

import pytest
import torch

import torchreg as tr

CAMERA = tr.Camera(64, 48, (60.0, 60.0, 31.5, 23.5))
NOISE = 0.002


def pictures(places, generator=None, wall=2.0):
    """Return pictures of a box at columns of a wall, one metre before it, and the masks of the box."""
    generator = generator or torch.Generator().manual_seed(0)
    frames, masks = [], []
    for column in places:
        depth, mask = torch.full((48, 64), wall), torch.zeros(48, 64, dtype=torch.bool)
        mask[15:33, column : column + 14] = True
        depth[mask] = wall - 1
        depth = depth + NOISE * depth.square() * torch.randn(48, 64, generator=generator)
        frames.append(tr.DepthFrame(depth, CAMERA))
        masks.append(mask)
    return frames, masks


def test_the_background_is_what_lies_behind_a_thing_that_moves_however_long_it_stays():
    frames, masks = pictures([4, 4, 4, 30])
    found = tr.Background.of(frames)
    torch.testing.assert_close(found.depth, torch.full_like(found.depth, 2.0), rtol=0, atol=6 * 4 * NOISE)
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    assert found.share == pytest.approx(float(torch.stack(masks).double().mean()), rel=0.1)
    for frame, mask in zip(frames, masks, strict=True):
        moved = found.moved(frame)
        assert float((moved & mask).sum()) > 0.85 * float(mask.sum())  # edges of one pixel are of no surface
        assert int((moved & ~mask).sum()) == 0


def test_a_picture_that_told_nothing_of_the_background_is_compared_with_it():
    frames, _ = pictures([4, 30])
    later, masks = pictures([17], torch.Generator().manual_seed(1))
    moved = tr.Background.of(frames).moved(later[0])
    assert float((moved & masks[0]).sum()) > 0.85 * float(masks[0].sum())
    assert not bool((moved & ~masks[0]).any())


def test_nothing_moves_in_equal_scenes_and_lengths_have_no_unit():
    frames, _ = pictures([4, 4, 4])
    assert not bool(tr.Background.of(frames).moved(frames[0]).any())


def test_pixels_without_depth_are_no_background_and_do_not_move():
    frames, _ = pictures([4, 30])
    blind = [tr.DepthFrame(torch.where(torch.arange(64) < 2, 0.0, frame.depth), CAMERA) for frame in frames]
    found = tr.Background.of(blind)
    assert not bool((found.depth[:, :2] > 0).any())
    assert not bool(found.moved(frames[0])[:, :2].any())


def test_one_picture_other_cameras_and_other_sizes_are_refused():
    frames, _ = pictures([4, 30])
    with pytest.raises(tr.errors.InputError, match="at least two pictures"):
        tr.Background.of(frames[:1])
    other = tr.DepthFrame(frames[0].depth, tr.Camera(64, 48, (61.0, 60.0, 31.5, 23.5)))
    with pytest.raises(tr.errors.InputError, match="one camera that stands still"):
        tr.Background.of([frames[0], other])
    with pytest.raises(tr.errors.InputTypeError, match=r"frames\[1\] must be a DepthFrame"):
        tr.Background.of([frames[0], frames[1].depth])
    small = tr.DepthFrame(torch.ones(10, 12), tr.Camera(12, 10, (20.0, 20.0, 6.0, 5.0)))
    with pytest.raises(tr.errors.InputError, match="background's size"):
        tr.Background.of(frames).moved(small)
