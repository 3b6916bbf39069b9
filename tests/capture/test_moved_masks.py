"""What moved between two depth pictures of a room, and what a registration makes of such pictures."""

import pytest
import torch

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from experiments.made_up.rooms import box, joined, moved
from torchreg.capture.moved import moved_scans
from torchreg.errors import FileWarning, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.geometry.visibility import rasterize

EYE = torch.eye(3)
WALL = moved(box((8, 6, 0.1)), EYE, torch.tensor([0.0, 0.0, 4.0]))
FLOOR = moved(box((8, 0.1, 3)), EYE, torch.tensor([0.0, 0.95, 3.0]))
STILL = torch.eye(4, dtype=torch.float64)
SHELF = moved(box((0.5, 1.2, 0.4)), EYE, torch.tensor([-0.9, 0.35, 3.0]))
ARM_DOWN, ARM_UP = (0.35, 0.1, 2.5), (0.35, -0.55, 2.5)


def figure(arm, step=0.0):
    """A trunk and an arm, one surface in the picture, that stand on the floor."""
    shift = torch.tensor([0.3 + step, 0.0, 0.0])
    return [
        moved(box((0.4, 1.3, 0.3)), EYE, shift + torch.tensor([0.0, 0.25, 2.5])),
        moved(box((0.5, 0.15, 0.15)), EYE, shift + torch.tensor(arm)),
    ]


def pictures(first, second, motion=STILL, scale=1.0, noise=None):
    """Frames of the room with both figures, the second one by a moved camera, and the masks that show them."""
    frames, masks = [], []
    for number, (thing, pose) in enumerate(((first, STILL), (second, motion))):
        camera = tr.Camera(
            160,
            120,
            (120.0, 120.0, 79.5, 59.5),
            torch.cat((pose[:, :3], pose[:, 3:] * torch.tensor([[scale]] * 3 + [[1.0]])), 1),
        )
        scene = joined([*thing, WALL, FLOOR, SHELF])
        local = tr.TriangleMesh(scene.vertices.double() @ pose[:3, :3].mT + pose[:3, 3], scene.faces)
        raster = rasterize(local, tr.Camera(160, 120, camera.intrinsics).view())
        depth = torch.where(raster.face_index >= 0, scale * raster.depth, 0.0)
        if noise is not None:
            depth = noise.measured(depth, torch.Generator().manual_seed(number))
        frames.append(tr.DepthFrame(depth, camera))
        masks.append((raster.face_index >= 0) & (raster.face_index < sum(len(part.faces) for part in thing)))
    return frames, masks


def overlap(found, mask, frame):
    true = mask & frame.measured
    return float((found & true).sum() / (found | true).sum())


@pytest.mark.parametrize("noise", [None, DepthNoise.structured_light(), DepthNoise.time_of_flight()])
def test_a_figure_that_moved_is_found_and_what_stays_is_not(noise):
    frames, masks = pictures(figure(ARM_DOWN), figure(ARM_UP, 0.25), noise=noise)
    found = tr.moved_masks(*frames)
    for mask, true, frame in zip((found.source, found.target), masks, frames, strict=True):
        assert overlap(mask, true, frame) > 0.8
    depth = frames[0].depth[frames[0].depth > 0].median()
    expected = 0.0 if noise is None else float(noise.depth_std(depth))
    assert found.noise * depth**2 == pytest.approx(expected, rel=1.0, abs=1e-6)


def test_an_arm_that_moved_alone_is_found():
    frames, masks = pictures(figure(ARM_DOWN), figure(ARM_UP))
    found = tr.moved_masks(*frames)
    arm = masks[0] & ~masks[1]  # in front of the wall
    assert (found.source & arm).sum() > 0.9 * arm.sum()
    assert not (found.source & ~masks[0]).any()


def test_the_order_the_scale_and_known_camera_motions_change_nothing():
    things = figure(ARM_DOWN), figure(ARM_UP, 0.25)
    frames, _ = pictures(*things)
    found = tr.moved_masks(*frames)
    back = tr.moved_masks(*frames[::-1])
    assert torch.equal(found.source, back.target)
    assert torch.equal(found.target, back.source)
    scaled = tr.moved_masks(*pictures(*things, scale=2.0)[0])
    assert (scaled.source ^ found.source).sum() < 20
    motion = se3_exp(torch.tensor([0.1, 0.05, -0.1, 0.02, 0.06, 0.01], dtype=torch.float64))
    frames, masks = pictures(*things, motion=motion)
    seen = tr.moved_masks(*frames)
    for mask, true, frame in zip((seen.source, seen.target), masks, frames, strict=True):
        assert overlap(mask, true, frame) > 0.8


def test_nothing_moved_gives_empty_masks_and_a_registration_of_everything():
    frames, _ = pictures(figure(ARM_DOWN), figure(ARM_DOWN), noise=DepthNoise(quadratic=1e-3))
    found = tr.moved_masks(*frames)
    assert not (found.source | found.target).any()
    assert torch.equal(found.motion, STILL)
    with pytest.warns(FileWarning, match="nothing is found to move"):
        scans = moved_scans(*frames)
    assert len(scans[0].points) == int(frames[0].measured.sum())


@pytest.mark.parametrize("noise", [None, DepthNoise(quadratic=1e-3)])
def test_a_camera_in_a_hand_does_not_make_the_room_move(noise):
    motion = se3_exp(torch.tensor([0.05, -0.02, 0.08, 0.02, -0.03, 0.02], dtype=torch.float64))
    frames, masks = pictures(figure(ARM_DOWN), figure(ARM_UP, 0.25), motion=motion, noise=noise)
    unknown = [tr.DepthFrame(frame.depth, frames[0].camera) for frame in frames]
    found = tr.moved_masks(*unknown)
    corners = torch.tensor([[-0.9, 0.35, 3.0], [-1.5, 0.9, 3.0], [1.5, 0.9, 4.0]], dtype=torch.float64)
    there, true = transform_points(found.motion, corners), transform_points(motion, corners)
    # No surface of the room holds a slide to the side.
    assert (there - true)[:, 1:].norm(dim=-1).max() < 0.02
    for mask, true, frame in zip((found.source, found.target), masks, frames, strict=True):
        assert overlap(mask, true, frame) > 0.8


def test_a_registration_of_two_pictures_is_of_what_moved():
    frames, masks = pictures(figure(ARM_DOWN), figure(ARM_UP, 0.1))
    with pytest.warns(FileWarning, match=r"of source and \d+ of \d+ of target show what did not move"):
        found = tr.register(*frames, num_bones=4, grid_resolution=20)
    column, row = frames[0].camera.project(found.points.double())[0].round().long().unbind(-1)
    assert masks[0][row, column].double().mean() > 0.97
    masked = [tr.DepthFrame(frame.depth, frame.camera, mask) for frame, mask in zip(frames, masks, strict=True)]
    assert len(tr.register(*masked, num_bones=4, grid_resolution=20).points) == int(masked[0].measured.sum())


def test_something_else_than_a_picture_is_refused():
    frames, _ = pictures(figure(ARM_DOWN), figure(ARM_UP))
    with pytest.raises(InputTypeError, match="target must be a DepthFrame, got Tensor"):
        tr.moved_masks(frames[0], frames[1].depth)
