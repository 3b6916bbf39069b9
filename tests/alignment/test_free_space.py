"""Depth frames in alignment: free space in the objective and in the choice of poses, crops of whole pictures."""

import pytest
import torch

import torchreg as tr
from tests.alignment.conftest import CAMERA
from tests.alignment.made import problem_of
from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import alignment_cost
from torchreg.capture.depth_segments import SurfaceGrid, beyond_cut, candidate_crops


def problems_of(skin, pose, frame):
    """Return the problem of a frame with its free space and without."""
    data = frame.points[None]
    for space in (frame.free_space, None):
        yield problem_of(skin, data, pose[None], origin=data.mean(1), prior_std=0.3, free_space=space)


def test_the_term_is_the_gradient_of_its_cost(links, links_skin, links_pose, picture):
    term = FreeSpaceTerm.of_skin(picture.free_space, links_skin, 0.3)
    pose = links.retract(links_pose, 0.1 * torch.ones_like(links_pose))[None]
    sigma, noise = pose.new_tensor([0.03]), pose.new_tensor([0.002])
    found = term.linearized(pose, sigma, noise)
    assert float(found.cost) > 0
    torch.testing.assert_close(found.cost, term.cost(pose, sigma, noise))
    steps = 1e-6 * torch.eye(pose.shape[1], dtype=pose.dtype)
    ahead, back = (
        torch.stack([term.cost(links.retract(pose, sign * step[None]), sigma, noise)[0] for step in steps])
        for sign in (1, -1)
    )
    torch.testing.assert_close(found.gradient[0], (ahead - back) / 2e-6, rtol=1e-3, atol=1e-3 * float(found.cost))


def test_a_pose_costs_what_would_be_seen_of_it(links, links_skin, links_pose, picture):
    before = links_pose.clone()
    before[2] -= 0.2
    behind = links_pose.clone()
    behind[2] += 0.2
    with_space, without = problems_of(links_skin, links_pose, picture)

    def extra(pose):
        local = pose[None].clone()
        local[:, :3] -= with_space.origin
        return float(alignment_cost(with_space, local) - alignment_cost(without, local))

    assert extra(links_pose) == pytest.approx(0, abs=2)
    assert extra(behind) < 0.2 * extra(before)
    assert 0.2 * len(picture.points) < extra(before) < 2 * len(picture.points)
    # A limb that no points show may be anywhere but where the picture shows the wall.
    bent = links_pose.clone()
    bent[6:] = torch.tensor([-1.5, 0.0])
    assert extra(bent) > 20


def test_a_frame_is_aligned_as_its_points_and_a_batch_as_each_alone(links, links_skin, links_pose, picture):
    start = links.retract(links_pose, 0.03 * torch.ones_like(links_pose))
    config = tr.AlignConfig(search="never")
    alone = tr.align(links, picture, start, model_points=links_skin, config=config)
    assert torch.allclose(links.keypoints(alone.pose), links.keypoints(links_pose), atol=2e-3)
    smaller = picture.cropped(torch.arange(96).expand(72, -1) < 60)
    batch = tr.align(links, [picture, smaller], start.expand(2, -1), model_points=links_skin, config=config)
    # The steps of a batch end together.
    torch.testing.assert_close(batch.pose[0], alone.pose, atol=1e-3, rtol=0)
    assert batch.statuses[0] is tr.Status.CONVERGED
    far = torch.tensor([3e5, -2e5, 1e4], dtype=torch.float64)
    moved = tr.align(
        links, picture.near(-far), start + torch.nn.functional.pad(far, (0, 5)), model_points=links_skin, config=config
    )
    torch.testing.assert_close(moved.pose[:3] - far, alone.pose[:3], atol=1e-6, rtol=0)


def scene():
    """A wall at 2 m, and before it a strip of 8 x 48 cm at 1 m that leaves the picture to the right."""
    depth = torch.full((72, 96), 2.0, dtype=torch.float64)
    depth[30:39, 43:] = 1.0
    return tr.DepthFrame(depth, CAMERA)


def crops_of(frame, size):
    grid = SurfaceGrid.of(frame, size).without_planes(size)
    return [frame.cropped(grid.mask(kept)) for kept in candidate_crops(grid, size)]


def test_crops_are_the_ends_of_the_nearest_surface_first_but_no_large_planes():
    crops = crops_of(scene(), 0.2)
    first, second = crops[:2]
    assert float(first.points[:, 2].max()) == 1.0
    column = first.pixels[:, 0]
    assert int(column.min()) == 43
    assert 0.15 <= (int(column.max()) - 43) / 110 <= 0.25
    assert int(second.pixels[:, 0].max()) == 95
    assert all(float(crop.points[:, 2].max()) == 1.0 for crop in crops)  # a wall is larger than the shape
    wall = tr.DepthFrame(torch.full((72, 96), 2.0, dtype=torch.float64), CAMERA)
    assert not crops_of(wall, 0.2)


def test_surfaces_near_each_other_are_one_crop_before_each_of_them():
    depth = torch.full((72, 96), 2.0, dtype=torch.float64)
    depth[25:45, 30:42], depth[25:45, 42:54] = 1.0, 1.06  # two parts of 11 cm, one before the other
    depth[25:45, 80:90] = 1.05
    both, *single = crops_of(tr.DepthFrame(depth, CAMERA), 0.4)
    assert int(both.pixels[:, 0].min()) == 30
    assert int(both.pixels[:, 0].max()) == 53
    assert [sorted({round(float(z), 2) for z in crop.points[:, 2]}) for crop in single] == [[1.0], [1.05], [1.06]]


def test_what_a_crop_cuts_off_is_told_from_what_stands_alone():
    frame = scene().cropped(torch.arange(96).expand(72, -1) < 80)
    strip = (frame.pixels[:, 0] > 43) & (frame.points[:, 2] < 1.5)
    # Off the shape: the strip from its middle on, and a piece of its near end.
    off = strip & ((frame.pixels[:, 0] > 60) | (frame.pixels[:, 0] < 48))
    cut = beyond_cut(frame, off)
    assert torch.equal(cut, strip & (frame.pixels[:, 0] > 60))


def test_in_a_picture_of_planes_alone_the_shape_is_not_found(links, links_skin):
    across = torch.arange(96, dtype=torch.float64)
    corner = tr.DepthFrame((2.0 - 0.005 * (across - 50).abs()).expand(72, -1).clone(), CAMERA)
    found = tr.align(links, corner, model_points=links_skin)
    assert found.status is tr.Status.NOT_FOUND
    assert not found.status.usable
    assert found.doubt.startswith("not found in the picture: the best pose is wrong with a probability of")
