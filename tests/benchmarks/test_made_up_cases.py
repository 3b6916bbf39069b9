"""The clouds, starts, scans and scenes that benchmarks draw are what they promise."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from experiments.made_up import rooms
from experiments.made_up.walks import walking_figure
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.viz.gltf import save_shape_animation


def turn_between(one, other):
    """Return the angle in degrees of the rotation between two rotation vectors."""
    turns = [torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3), -v.expand(3, 3))) for v in (one, other)]
    return math.degrees(math.acos(min((float((turns[0] @ turns[1].T).trace()) - 1) / 2, 1.0)))


def test_tubes_of_bones_bend_at_their_joints(load):
    tube = load("bones").make_tube(4, 200, 10, torch.float64)
    motions, joint = tube.pose(0.7), torch.tensor([2.0, 0, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(motions[1] @ joint, motions[2] @ joint)
    assert torch.equal(tube.pose(0.0), torch.eye(4, dtype=torch.float64).repeat(4, 1, 1))


def test_big_clouds_of_the_arm_lie_on_it_but_for_the_outliers(load, tmp_path):
    bench = load("big_scans")
    arm = bench.shape_of("arm", tmp_path)
    cloud = bench.cloud_of("arm", arm, 3000)
    near = arm.distance(cloud, bench.true_pose("arm", arm)).abs() < 0.02
    assert cloud.shape == (3000, 3)
    assert 0.85 < float(near.double().mean()) < 0.97


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


def test_front_clouds_show_one_side_and_clutter(load, plain_hand, plain_hand_surface):
    bench, generator = load("find_pose"), torch.Generator().manual_seed(2)
    whole, front = (bench.make_cloud(plain_hand, case, plain_hand_surface, generator) for case in bench.CASES)
    assert bool(whole.inliers.all())
    assert 45 <= int((~front.inliers).sum()) <= 60
    assert int(whole.inliers.sum()) == int(front.inliers.sum()) == 500
    assert int(bench.seen_tips(plain_hand, whole).sum()) >= int(bench.seen_tips(plain_hand, front).sum())


def test_rigs_are_found_by_the_search_and_by_a_network_and_in_their_clips(load, arm, person, tmp_path):
    bench = load("find_pose")
    network = tr.PoseProposer(arm, tr.ProposerSize(points=64, tokens=16, width=16, heads=2, encoder=1, decoder=1))
    rows = bench.measure_rig(arm, network, 1, 0)
    assert [row.way for row in rows] == ["search", "network"]
    assert all(row.errors.shape == (1,) and bool(torch.isfinite(row.errors).all()) for row in rows)
    assert rows[0].render().startswith("search   1 clouds, within 5%: ")
    mesh = trimesh.Trimesh(person.vertices(person.rest_pose()).numpy(), person.surface.faces.numpy())
    mesh.export(tmp_path / "bare.glb")
    assert bench.measure_clip(person, tmp_path / "bare.glb", 1, 0) is None
    save_shape_animation(tmp_path / "still.glb", person, person.rest_pose().expand(3, -1), fps=2)
    row = bench.measure_clip(tr.ArticulatedShape.from_gltf(tmp_path / "still.glb"), tmp_path / "still.glb", 1, 0)
    assert row.way == "clip"
    assert float(row.errors) < 0.05


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


def test_views_are_named_by_what_faces_the_camera(load, plain_hand):
    bench, pose = load("pose_initializer"), plain_hand.rest_pose()
    pose[2] = 0.5
    # The back of the hand looks along y, the fingers along z.
    views = {(0.0, 0, 0): "along the fingers", (-1.5708, 0, 0): "back", (1.5708, 0, 0): "palm", (0, 1.5708, 0): "edge"}
    for turn, view in views.items():
        pose[3:6] = torch.tensor(turn)
        assert bench.view_of(plain_hand, pose) == view
    with bench.counted(plain_hand) as total:
        plain_hand.distance(torch.zeros(2, 7, 3), plain_hand.rest_pose().expand(2, -1))
    assert total == [2 * 7 * plain_hand.num_parts]
    assert "plane_distance" not in vars(plain_hand.primitives)


def test_rivals_get_the_same_iterations_and_range_of_sigma(load):
    bench = load("rivals")
    conditions = bench.conditions("whole")
    assert len(conditions) == 12
    for condition in conditions:
        fields = ("outliers", "start_deg", "points")
        changed = sum(getattr(condition, name) != getattr(bench.Condition("whole"), name) for name in fields)
        assert changed == (condition != bench.Condition("whole"))
    *rivals, surface, default = bench.methods(0.2).items()
    assert (len(rivals), surface[0], default) == (7, "EM + surface fit", ("default", tr.AlignConfig()))
    for _, config in rivals:
        assert config.schedule.steps * config.em_steps == 30
        assert config.schedule.values[0] == pytest.approx(0.016)
        assert config.schedule.values[-1] == pytest.approx(0.004)
        assert (config.surface_steps, config.search, config.prior_std) == (0, "never", None)


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


def test_flips_end_where_the_hand_stops_to_turn(load, plain_hand, plain_hand_surface):
    """Frames with errors of 9 mm for some frames after the first turn are back after them."""
    bench, made = load("tracking"), load("own_hand")
    poses = made.hand_motion(plain_hand, "flip", 160)
    clouds = [SimpleNamespace(pose=pose) for pose in poses]
    errors, seen = torch.full((160, 5), 1.0), torch.ones(160, 5, dtype=torch.bool)
    tracked = bench.Track(None, errors, seen, seen[:, 0])
    assert bench.frames_back(tracked, clouds) == [0, 0]
    turning = (poses[1:, 3:6] - poses[:-1, 3:6]).norm(dim=-1)
    last = int(turning[:80].argmax()) + 4
    errors[last : last + 12] = 9.0
    first, second = bench.frames_back(tracked, clouds)
    assert 0 < first <= 12
    assert second == 0
    bent = made.hand_motion(plain_hand, "bend", 2)
    clouds = made.range_clouds(plain_hand, bent, num_points=500, camera=torch.zeros(3), skin=plain_hand_surface)
    errors = bench.least_squares(plain_hand, clouds)
    assert errors.shape == (2, 5)
    assert float(errors.mean()) < 2.5  # better than the noise


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


@pytest.fixture
def egg_file(tmp_path):
    """A file in which an egg a hundred units high, its end up, moves along x, a tenth of its height a frame."""
    ball = trimesh.creation.icosphere(3)
    egg = ball.vertices * [30.0, 50.0, 30.0]
    vertices = np.stack([egg + np.array([10.0 * frame, 7.0, 0.0]) for frame in range(5)])
    np.savez(tmp_path / "egg.npz", vertices=vertices, faces=ball.faces)
    return tmp_path / "egg.npz"


def test_captured_scans_lie_at_their_true_places_and_move_with_them(load, egg_file):
    bench = load("captured_scans")
    first, last = bench.captured_sequences(egg_file, 2, 3, bench.DepthScanner(num_points=300, num_holes=0))
    assert (len(first), len(last)) == (3, 3)
    for sequence, side in ((first, 1.0), (last, -1.0)):
        points = sequence[0].points
        torch.testing.assert_close(sequence.truth(0, 0), points, atol=0.02, rtol=0)
        moved = sequence.truth(0, 2) - sequence.truth(0, 0)
        # Half a turn later the same motion goes the other way.
        step = side * 20.0 * bench.DIAGONAL / np.sqrt(60**2 + 100**2 + 60**2)
        torch.testing.assert_close(moved, torch.tensor([step, 0, 0]).expand_as(moved).float(), atol=1e-4, rtol=0)
        size = points.amax(0) - points.amin(0)
        assert float(size[1]) > 1.3 * float(size[0])
    with pytest.raises(ValueError, match=r"egg\.npz holds 5 frames; 6 are asked for"):
        next(bench.captured_sequences(egg_file, 1, 6))


def test_scans_of_people_show_one_side_with_noise_and_outliers(load):
    bench, ball = load("shape_fit"), trimesh.creation.icosphere(4)
    mesh = tr.TriangleMesh(torch.from_numpy(np.array(ball.vertices)), torch.from_numpy(np.array(ball.faces)).long())
    data = bench.one_sided_scan(mesh, 0.01, 950, torch.Generator().manual_seed(0))
    assert len(data) == 1000
    seen = data[:950]
    assert float((seen.norm(dim=-1) - 1).abs().mean()) == pytest.approx(0.01 * math.sqrt(2 / math.pi), rel=0.15)
    side = torch.nn.functional.normalize(seen.mean(0), dim=0)
    # From 1.7 diagonals away nothing is visible below the horizon at 1 / distance.
    assert float((seen @ side).quantile(0.01)) > 1 / (bench.DISTANCE * 12**0.5) - 0.1


def save_pair(path, pair):
    np.savez(
        path, source_points=pair.source.points, source_faces=pair.source.faces, target_points=pair.target.points,
        target_faces=pair.target.faces, source_truth=pair.truth, diagonal=pair.source.diagonal,
    )  # fmt: skip


def test_pairs_from_files_are_aligned_and_scored(load, capsys, tmp_path):
    bench = load("scan_alignment")
    save_pair(tmp_path / "one.npz", walking_figure(3, scanner=bench.DepthScanner(num_points=800)).pair(0, 1))
    assert bench.main(["--data", str(tmp_path), "--smoke"]) == 0
    printed = capsys.readouterr().out
    assert "skipped" not in printed
    assert "one" in printed
    assert " of 1" in printed


@pytest.fixture(scope="module")
def problem(load):
    return next(load("scan_registration").made_up_problems("toy", 1, 600))


def test_the_truth_of_scans_is_scored_as_such(load, problem):
    bench = load("scan_registration")
    found = tr.register(problem.source, problem.target, 6, 20, start=problem.truth)
    rand, errors = bench.parts_and_joints(found, bench.PartTruth.of_pair(problem.pair))
    assert 0 < rand <= 1
    assert 0 <= min(errors) < 0.1


def test_moved_problems_are_the_same_a_hundred_times_as_large(load, problem):
    moved = load("scan_registration").moved(problem)
    assert moved.diagonal == pytest.approx(100 * problem.diagonal)
    for before, after in ((problem.source.points, moved.source.points), (problem.truth, moved.truth)):
        torch.testing.assert_close(torch.pdist(after), 100 * torch.pdist(before), rtol=1e-4, atol=1e-3)
    between, after = ((one.truth - one.source.points).norm(dim=-1) for one in (problem, moved))
    torch.testing.assert_close(after, 100 * between, rtol=1e-3, atol=1e-3)
    assert moved.pair is None


def test_tables_of_registration_are_printed_for_files(load, problem, capsys, tmp_path, monkeypatch):
    bench, register = load("scan_registration"), tr.register
    save_pair(tmp_path / "one.npz", problem)

    def known(source, target, bones, grid, config):
        return register(source, target, bones, 20, config, start=problem.truth)

    monkeypatch.setattr(bench.tr, "register", known)
    assert bench.main(["--data", str(tmp_path), "--pairs", "0", "--ablations"]) == 0
    printed = capsys.readouterr().out
    assert "without turns held" in printed
    assert "bones 15" in printed


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


def test_meshes_of_files_and_gaits_are_meshed_anew(load, tmp_path, monkeypatch, capsys):
    bench = load("skeletonize")
    monkeypatch.setattr(bench, "RESOLUTION", 24)
    figure = bench.person(spacing=0.06)
    vertices = figure.mesh.vertices.float().numpy()
    np.savez(tmp_path / "samba.npz", vertices=np.stack((vertices, vertices)), faces=figure.mesh.faces.int().numpy())
    frames = list(bench.from_file(tmp_path / "samba.npz"))
    assert len(frames) == 2
    assert torch.equal(frames[0].vertices, frames[1].vertices)
    assert frames[0].num_vertices != len(vertices)
    assert len(list(bench.walking(figure, bench.person_walk, 2))) == 2
    assert len(bench.everything(None)) + 2 == len(bench.everything(tmp_path))
    assert "horse and dancer are skipped" in capsys.readouterr().out
    meshes = bench.creature_sequence(bench.STARFISH, 1, resolution=24).meshes
    passed = [bench.drawn("x", iter(meshes), *bars)[0].passed for bars in (((5, 5), 1), ((6, 7), 1), ((5, 5), 2))]
    assert passed == [True, False, False]


def test_spines_of_files_are_judged_by_their_vertices_and_timed(load, tmp_path, capsys, monkeypatch):
    bench = load("spines")
    still = bench.creature_sequence(bench.STARFISH, 1, resolution=40).meshes[0]
    turns = torch.tensor([[0.0, -0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]).double()
    frames = [still.vertices.double() @ torch.linalg.matrix_exp(k * turns).mT for k in range(14)]
    np.savez(tmp_path / "star.npz", vertices=torch.stack(frames).float().numpy(), faces=still.faces.int().numpy())
    (row,) = bench.main(["--smoke", "--part", "captured", "--data", str(tmp_path)])
    assert (row.tips, row.own, row.named, row.trees) == (5, 1.0, 1.0, (1, 1))
    assert "s on two cores: pass" in capsys.readouterr().out
    given = []
    monkeypatch.setattr(bench.tr, "extract_spine", lambda meshes, workers: given.append((len(meshes), workers)))
    bench.main(["--smoke", "--part", "speed", "--data", str(tmp_path)])
    assert given == [(3, 2)]
    assert "3 frames of" in capsys.readouterr().out
