"""The clouds, starts, scans and scenes that benchmarks draw are what they promise."""

import math

import pytest
import torch

from experiments.made_up import rooms
from torchreg.geometry.rotation import so3_exp, so3_log


def turn_between(one, other):
    """Return the angle in degrees of the rotation between two rotation vectors."""
    turns = [torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3), -v.expand(3, 3))) for v in (one, other)]
    return math.degrees(math.acos(min((float((turns[0] @ turns[1].T).trace()) - 1) / 2, 1.0)))


def test_poses_to_find_have_any_rotation_and_joints_bent_to_half_their_range(load, plain_hand):
    bench, generator = load("find_pose"), torch.Generator().manual_seed(1)
    poses = torch.stack([bench.random_pose(plain_hand, generator) for _ in range(300)])
    bend = poses[:, 6:].amax(0) / plain_hand.upper[6:].clamp_min(1e-3)
    assert float(bend.max()) <= 0.5 + 1e-6
    assert float(bend[plain_hand.upper[6:] > 0].min()) > 0.45
    # The mean angle of uniform rotations is pi / 2 + 2 / pi.
    assert float(poses[:, 3:6].norm(dim=-1).mean()) == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.12)
    assert float(torch.nn.functional.normalize(poses[:, 3:6], dim=-1).mean(0).abs().max()) < 0.12
    assert float((poses[:, :3] - torch.tensor([0.0, 0.0, 0.5])).abs().max()) == 0


def test_starts_of_own_hands_are_as_far_off_as_stated(load, plain_hand):
    hand, middle = plain_hand, plain_hand.rest_pose()
    middle[6:] = (0.5 * (hand.lower + hand.upper))[6:]
    middle[3:6] = torch.tensor([0.3, -0.5, 0.2])
    starts = load("own_hand").start_of(hand, middle, torch.Generator().manual_seed(1))
    moved = torch.rad2deg((starts["joints"] - middle).abs())
    assert torch.allclose(moved[6:], torch.rad2deg((hand.upper - hand.lower)[6:] / 2).clamp_max(20), atol=1e-3)
    assert torch.allclose(starts["joints"][:6], middle[:6], atol=1e-6)
    turned = starts["joints+base"]
    assert turn_between(turned[3:6], middle[3:6]) == pytest.approx(20, abs=0.02)
    assert float((turned[:3] - middle[:3]).norm()) == pytest.approx(0.02, abs=1e-6)


def test_the_bound_agrees_with_repeated_least_squares(load, plain_hand, plain_hand_surface):
    """On noise alone, without outliers, estimates scatter around the truth as the bound predicts."""
    bench, generator = load("own_hand"), torch.Generator().manual_seed(5)
    pose, spread = bench.random_hand_pose(plain_hand, generator), []
    settings = {"skin": plain_hand_surface, "outlier_ratio": 0.0, "camera": torch.zeros(3), "generator": generator}
    for _ in range(8):
        trial = bench.make_trial(plain_hand, bench.make_hand_cloud(plain_hand, pose, **settings), generator)
        trial.starts["joints"] = pose
        found = bench.least_squares(plain_hand, trial, "joints")
        spread.append(bench.seen_errors(plain_hand, [found], [trial]).square().mean().sqrt())
    bound = bench.bound_draws(plain_hand, trial, generator).square().mean().sqrt()
    assert 0.5 < float(torch.stack(spread).mean() / bound) < 1.5


def test_starts_of_rivals_are_as_far_off_as_stated(load, plain_hand, plain_hand_surface, plain_hand_skin):
    bench = load("rivals")
    conditions = (("one side", {"start_deg": 10}), ("whole", {"outliers": 0.5}), ("tracked", {}))
    trial, again, tracked = (
        bench.make_trial(plain_hand, plain_hand_surface, plain_hand_skin, bench.Condition(view, **settings), 3)
        for view, settings in conditions
    )
    off = torch.rad2deg((trial.start - trial.cloud.pose).abs())
    assert float(off[6:].max()) == pytest.approx(10, abs=1e-3)
    assert float(off[:6].max()) < 1e-5
    assert 1 <= int(trial.seen.sum()) <= 5
    assert trial.skin is plain_hand_skin
    torch.testing.assert_close(again.cloud.pose, trial.cloud.pose)
    assert float(again.cloud.inliers.double().mean()) == pytest.approx(0.5)
    # Model points of a tracked hand lie on what the camera at the origin saw of the start.
    assert len(tracked.skin.points) == 500
    with torch.no_grad():
        posed, every = tracked.skin(tracked.start), plain_hand_surface(tracked.start)
    assert float(plain_hand.distance(posed, tracked.start).abs().mean()) < 0.003
    assert float(posed[:, 2].mean()) < float(every[:, 2].mean())


@pytest.mark.parametrize(("kind", "seed"), [("hand", 4), ("arm", 1), ("held", 2)])
def test_scenes_show_their_shape_where_its_pose_is(kind, seed):
    scene = rooms.KINDS[kind](seed, True)
    keypoints = scene.shape.keypoints(scene.pose) if scene.keypoints is None else scene.keypoints
    pixels, depth = scene.frame.camera.project(keypoints.double())
    column, row = pixels.round().long().unbind(-1)
    inside = (column >= 0) & (column < rooms.WIDTH) & (row >= 0) & (row < rooms.HEIGHT)
    # Keypoints lie inside the shape, whose surface hides them; the pixel of a fingertip may miss it.
    nearer = scene.frame.depth[row[inside], column[inside]] < depth[inside] + 0.02
    assert float(nearer.double().mean()) > 0.7
    assert scene.is_right(scene.pose)
    off = scene.pose.clone()
    off[0] += 0.03
    assert not scene.is_right(off)
    absent, again = (rooms.KINDS[kind](3, False) for _ in range(2))
    assert torch.equal(absent.frame.depth, again.frame.depth)
    assert absent.pose is None
    assert not absent.is_right(absent.shape.rest_pose())


def test_an_arm_is_right_after_half_a_turn_of_its_foot():
    truth = torch.tensor([0.1, 0.2, 1.0, 0.3, -0.4, 0.2, 1.0, 0.5, -0.5])
    turned = truth.clone()
    turned[3:6] = so3_log(so3_exp(truth[None, 3:6]) @ torch.diag(torch.tensor([-1.0, -1.0, 1.0])))[0]
    assert not rooms.arm_is_right(turned, truth)
    turned[6] -= math.pi
    assert rooms.arm_is_right(turned, truth)
    turned[8] += 0.06
    assert not rooms.arm_is_right(turned, truth)


def test_windows_average_a_surface_but_not_across_its_rim():
    depth = torch.full((9, 12), 1.0)
    depth[:, 6:], depth[4, 3], depth[0, 0] = 0.5, 1.009, 0.0
    found = rooms.averaged(depth, 1)
    assert found[4, 3] == pytest.approx(1.001, abs=1e-5)
    assert torch.equal(found[:, 6:], depth[:, 6:])
    assert found[0, 0] == 0
    assert torch.equal(rooms.averaged(depth, 0), depth)


@pytest.mark.parametrize("script", ["scan_confidence", "scan_matching"])
def test_smoke_runs_on_one_kind_print_it(load, script, capsys, monkeypatch):
    bench = load(script)
    if script == "scan_matching":
        monkeypatch.setattr(bench, "HELD_OUT_KINDS", dict(list(bench.HELD_OUT_KINDS.items())[1:2]))
    else:
        monkeypatch.setattr(bench, "held_out", lambda count: list(bench.training_kinds(count))[:2])
    assert bench.main(["--smoke"]) == 0
    printed = capsys.readouterr().out
    assert ("of 1 right" if script == "scan_confidence" else "\nall ") in printed
    assert "skipped" in printed
