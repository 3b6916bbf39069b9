"""Scans of a toy and by the made-up camera: their truth against the surface that was scanned."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.datasets import depth_scanner, scan_sequences, solids

MIDDLE = (0.1, 0.05, 3.0)
BALL = solids.mesh_of([solids.ball(MIDDLE, 0.5)], 0.05)
CLEAN = depth_scanner.DepthScanner(noise=0.0, num_holes=0)


@pytest.fixture(scope="module")
def toy():
    return scan_sequences.jointed_toy(
        8, missing=True, dtype=torch.float64, scanner=depth_scanner.DepthScanner(2500, noise=0.0, num_holes=0)
    )


def scan(scanner, mesh=BALL, seed=0, dtype=torch.float64):
    return scanner.scan(mesh, scanner.view(mesh, 0.4), torch.Generator().manual_seed(seed), dtype)


def test_a_pair_holds_what_fits_together(toy):
    pair = toy.pair(1, 2)
    assert pair.truth.shape == pair.source.points.shape
    assert pair.labels.shape == pair.visible.shape == pair.missing.shape == (len(pair.source),)
    assert pair.target_labels.shape == (len(pair.target),)
    assert pair.joints.shape == pair.target_joints.shape == (len(pair.part_names) - 1, 3)
    assert 0.5 < float(pair.visible.double().mean()) <= 1.0
    # What the target's camera sees of the truth, it has measured nearby.
    gap = torch.cdist(pair.truth[pair.visible], pair.target.points).amin(1)
    assert float(gap.quantile(0.9)) < 2 * pair.target.spacing
    same = toy.pair(6, 6)
    torch.testing.assert_close(same.truth, same.source.points)
    shares = same.error(same.truth + 0.3) * same.source.diagonal
    torch.testing.assert_close(shares, torch.full_like(shares, 0.3 * math.sqrt(3)))


def test_rigid_parts_move_as_their_transforms_say(toy):
    pair = toy.pair(0, 1)
    for part in pair.labels.unique().tolist():
        own = pair.labels == part
        moved = pair.source.points[own] @ pair.transforms[part, :3, :3].mT + pair.transforms[part, :3, 3]
        torch.testing.assert_close(moved, pair.truth[own], atol=1e-9, rtol=0)
    for number, parts in enumerate(pair.joint_parts.tolist()):
        for part in parts:
            moved = pair.transforms[part, :3, :3] @ pair.joints[number] + pair.transforms[part, :3, 3]
            torch.testing.assert_close(moved, pair.target_joints[number])


def test_missing_parts_are_missing_in_every_other_frame(toy):
    for frame in range(len(toy)):
        assert (toy.missing[frame] >= 0) == (frame % 2 == 1)
        assert toy.missing[frame] not in toy.labels(frame).tolist()
    gone = [toy.pair(frame, frame + 1) for frame in range(0, 6, 2)]
    for frame, pair in zip(range(0, 6, 2), gone, strict=True):
        assert torch.equal(pair.missing, pair.labels == toy.missing[frame + 1])
        assert not bool((pair.visible & pair.missing).any())
    assert any(bool(pair.missing.any()) for pair in gone)
    assert not bool(toy.pair(1, 2).missing.any())


def test_a_clean_scan_lies_exactly_where_it_says():
    found, single = scan(CLEAN), scan(CLEAN, dtype=torch.float32)
    assert single.scan.points.dtype == torch.float32
    torch.testing.assert_close(found.transferred(BALL.vertices, BALL.faces), found.scan.points)
    torch.testing.assert_close(single.scan.points.double(), found.scan.points, atol=1e-5, rtol=0)
    out = found.scan.points - torch.tensor(MIDDLE, dtype=torch.float64)
    assert float((out.norm(dim=-1) - 0.5).abs().max()) < 2e-3
    # The side that faces the camera, and normals that look at it.
    assert bool(((out * found.scan.points).sum(-1) < 0).all())
    assert bool(((found.scan.normals * found.scan.points).sum(-1) < 0).all())
    for count in (500, 3000):
        assert abs(len(scan(depth_scanner.DepthScanner(num_points=count)).scan) / count - 1) < 0.1


def test_noise_grows_with_depth_and_lies_along_the_rays():
    spreads = []
    for mesh in (BALL, solids.mesh_of([solids.ball((0, 0, 6), 1.0)], 0.1)):
        found = scan(depth_scanner.DepthScanner(noise=1e-3, num_holes=0, num_points=4000), mesh)
        truth = found.transferred(mesh.vertices, mesh.faces)
        error = found.scan.points - truth
        assert float(torch.linalg.cross(error, truth).norm(dim=-1).max()) < 1e-9
        spreads.append(float((error[:, 2] / truth[:, 2].square()).std()))
    assert spreads == pytest.approx([1e-3, 1e-3], rel=0.05)


def test_slanted_surfaces_and_holes_are_not_measured():
    for limit, slant in ((85, math.pi / 2), (52, math.radians(50))):
        points = scan(depth_scanner.DepthScanner(noise=0.0, num_holes=0, max_slant=slant)).scan.points
        out = torch.nn.functional.normalize(points - points.new_tensor(MIDDLE), dim=-1)
        angle = torch.rad2deg(torch.acos(-(out * torch.nn.functional.normalize(points, dim=-1)).sum(-1)))
        assert limit - 6 < float(angle.max()) < limit + 6
    holes = depth_scanner.DepthScanner(noise=0.0, num_holes=3, hole_radius=0.05)
    assert len(scan(holes).scan) < 0.97 * len(scan(CLEAN).scan)


def test_what_stands_before_something_hides_it():
    wall, post = solids.RoundBox((0, 0, 3), (0.8, 0.8, 0.05), 0.01), solids.RoundBox((0, 0, 2), (0.1, 0.6, 0.05), 0.01)
    points = scan(CLEAN, solids.mesh_of([wall, post], 0.05)).scan.points
    behind = points[points[:, 2] > 2.5]
    assert len(behind) > 100
    shadow = (behind[:, 0] / behind[:, 2]).abs() < 0.1 / 2 - 0.01
    low = (behind[:, 1] / behind[:, 2]).abs() < 0.6 / 2 - 0.05
    assert not bool((shadow & low).any())


def test_every_way_to_ask_gives_the_same(toy):
    pairs, alone = list(toy.pairs(2)), toy.pair(3, 5)
    assert len(pairs) == 6
    for name in ("truth", "labels", "target_labels", "joints", "visible"):
        assert torch.equal(getattr(pairs[3], name), getattr(alone, name))
    for one, other in (
        (alone.source.points, toy[3].points), (alone.target.points, toy[5].points), (alone.truth, toy.truth(3, 5)),
        (alone.labels, toy.labels(3)), (alone.joints, toy.joints(3)), (toy[-1].points, toy[7].points),
    ):  # fmt: skip
        assert torch.equal(one, other)
    assert all(isinstance(frame, tr.RangeScan) for frame in toy)
