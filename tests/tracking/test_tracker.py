"""Tracking: followed and restored sequences, bad frames, losses, covariances against repeated measurements."""

import math
from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch

import torchreg.tracking.recovery as recovery
from torchreg.alignment.results import PoseStarts
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.result import Status
from torchreg.storage import load
from torchreg.tracking.tracker import TrackConfig, Tracker

TIPS = [4, 8, 12, 16, 20]
FRAMES = 8


@pytest.fixture(scope="module")
def truths(plain_hand):
    return hand_motion(plain_hand, "bending_palm", FRAMES, seed=1)


@pytest.fixture(scope="module")
def clouds(plain_hand, plain_hand_surface, truths):
    return range_clouds(
        plain_hand, truths, num_points=400, outlier_ratio=0.2, camera=torch.zeros(3), skin=plain_hand_surface
    )


@pytest.fixture(scope="module")
def frames(clouds):
    return [cloud.points for cloud in clouds]


@pytest.fixture(scope="module")
def tracker(plain_hand, plain_hand_skin, truths):
    """Return a function that makes a tracker of the hand."""

    def make(initial_pose=truths[0], **config):
        return Tracker(plain_hand, initial_pose, config=TrackConfig(**config), model_points=plain_hand_skin)

    return make


@pytest.fixture(scope="module")
def followed(tracker, frames):
    """A tracker after all frames, its state after four, its records and the result of the run."""
    own, records, states = tracker(), [], []

    def on_frame(points, record):
        records.append((points, record))
        states.append(own.state)

    return own, states, records, own.run(frames, on_frame)


def tip_errors(hand, keypoints, clouds):
    true = torch.stack([cloud.keypoints for cloud in clouds])
    seen = torch.stack([cloud.seen_parts[list(hand.fingertip_parts)] for cloud in clouds])
    return (keypoints - true).norm(dim=-1)[:, TIPS][seen]


def same(first, second):
    """Return whether two records agree to the last bit."""
    pairs = [(getattr(first, item.name), getattr(second, item.name)) for item in fields(first)]
    return all(
        torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) if isinstance(a, torch.Tensor) else a == b or a != a
        for a, b in pairs
    )


def noise_frame(count=500, seed=0):
    """Points all over the room in which the hand moves."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator) * 0.5 + torch.tensor([-0.25, -0.25, 0.3])


def test_a_hand_is_followed(plain_hand, clouds, frames, followed):
    _, _, records, result = followed
    errors = tip_errors(plain_hand, result.keypoints, clouds)
    assert errors.mean() < 0.0025
    assert errors.max() < 0.008
    assert all(status.usable for status in result.statuses)
    assert result.acquired.count("tracked") >= FRAMES - 1
    assert [record.frame for _, record in records] == list(range(FRAMES))
    assert all(points is frame for (points, _), frame in zip(records, frames, strict=True))


def test_records_say_what_they_promise(plain_hand, clouds, followed):
    own, _, records, result = followed
    corners = own._fitter.skin.points.aminmax(dim=0)
    size = (corners.max - corners.min).norm()
    for cloud, (_, record) in zip(clouds, records, strict=True):
        inside = record.distances.isfinite()
        measured = plain_hand.distance(cloud.points, record.pose)
        torch.testing.assert_close(record.distances[inside], measured[inside], atol=2e-6, rtol=0)
        assert (measured[~inside].abs() > 0.02).all()
        assert torch.equal(record.inliers, record.distances.abs() < 0.02 * size)
        assert record.inlier_ratio == pytest.approx(float(record.inliers.float().mean()))
        # What is called an inlier is one, and outliers are few among them.
        assert (record.inliers == cloud.inliers).float().mean() > 0.9
        assert record.posterior[cloud.inliers].mean() > 4 * record.posterior[~cloud.inliers].mean()
        assert 0.0005 < record.residual < 0.003
        assert record.covariance.shape == (27, 27)
        assert (torch.linalg.eigvalsh(record.covariance.double()) > 0).all()
        torch.testing.assert_close(record.keypoints, plain_hand.keypoints(record.pose))
    assert torch.equal(result.poses, torch.stack([record.pose for _, record in records]))
    assert torch.equal(result.std, torch.stack([record.std for _, record in records]))
    assert (result.seconds > 0).all()
    assert result.times.tolist() == [float(k) for k in range(FRAMES)]


def test_results_and_states_come_back_from_files(followed, tmp_path):
    own, _, records, result = followed
    for number, saved in enumerate((result, own.state, records[-1][1])):
        saved.save(tmp_path / f"{number}.safetensors")
        assert same(load(tmp_path / f"{number}.safetensors"), saved)


def test_a_restored_state_goes_on_to_the_last_bit(tracker, frames, followed, tmp_path):
    _, states, records, _ = followed
    states[3].save(tmp_path / "state.safetensors")
    other = tracker()
    other.state = load(tmp_path / "state.safetensors")
    rest = other.run(frames[4:6])
    for number, (_, record) in enumerate(records[4:6]):
        assert torch.equal(rest.poses[number], record.pose)
        assert torch.equal(rest.std[number], record.std)
    assert same(other.state, states[5])


def test_states_do_not_grow(followed):
    _, states, _, _ = followed
    sizes = [state.keyframes.numel() for state in states]
    assert max(sizes) <= 3 * 27
    assert all(len(state.points) <= 400 and len(state.unexplained) < 200 for state in states)


def test_the_order_of_points_does_not_matter(tracker, frames, followed):
    _, states, records, _ = followed
    other = tracker()
    other.state = states[4]
    order = torch.randperm(len(frames[5]), generator=torch.Generator().manual_seed(3))
    record = other.step(frames[5][order])
    torch.testing.assert_close(record.pose, records[5][1].pose, atol=1e-3, rtol=0)
    assert (record.inliers == records[5][1].inliers[order]).float().mean() > 0.99


def test_a_moved_world_moves_the_base_alone(tracker, frames, followed):
    """The same data elsewhere, far from the origin, lead to the same joints."""
    _, states, records, _ = followed
    turn, shift = torch.tensor([0.3, -1.2, 0.4]), torch.tensor([3.0, -2.0, 1.0])
    matrix = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, -1.2], [0.4, 0.0, -0.3], [1.2, 0.3, 0.0]]))
    before = states[4].pose
    pose = torch.cat([matrix @ before[:3] + shift, compose_rotation_vectors(turn, before[3:6]), before[6:]])
    velocity = states[4].velocity.clone()
    velocity[:3], velocity[3:6] = matrix @ velocity[:3], matrix @ velocity[3:6]
    other = tracker()
    other.state = replace(states[4], pose=pose, velocity=velocity)
    record = other.step(frames[5] @ matrix.mT + shift)
    torch.testing.assert_close(record.pose[6:], records[5][1].pose[6:], atol=2e-2, rtol=0)
    torch.testing.assert_close(record.pose[:3], matrix @ records[5][1].pose[:3] + shift, atol=1e-3, rtol=0)


@pytest.mark.parametrize("model_points", ["data", "shape"])
def test_other_model_points_follow_too(plain_hand, tracker, clouds, frames, model_points):
    own = tracker(model_points=model_points)
    result = own.run(frames[:4])
    assert tip_errors(plain_hand, result.keypoints, clouds[:4]).mean() < 0.006
    assert all(status.usable for status in result.statuses)


def test_harvested_points_lie_on_the_data_and_are_spread_over_the_parts(plain_hand, plain_hand_skin, tracker, frames):
    own = tracker(model_points="data", num_model_points=120)
    own.run(frames[:2])
    state = own.state
    parts = state.weights.argmax(-1)
    counts = torch.bincount(parts, minlength=16)
    sampled = torch.bincount(plain_hand_skin.weights.argmax(-1), minlength=16)
    world = state.points + (state.pose - state.reference_pose)[:3]
    harvested = torch.cdist(world, frames[1]).amin(-1) < 1e-5
    for part in range(16):
        if harvested[parts == part].any():
            assert 4 <= counts[part] <= math.ceil(2 * 120 / 4)
        else:
            assert counts[part] == sampled[part]
    assert harvested.float().mean() > 0.5
    assert (plain_hand.distance(world[harvested], state.pose).abs() < 0.0056).all()
    torch.testing.assert_close(state.weights.sum(-1), torch.ones(len(state.points)))


def test_seen_points_face_the_camera(plain_hand, plain_hand_skin, followed):
    """The camera stands at the origin: most of what is kept of well-seen parts faces it."""
    own, _, _, _ = followed
    state = own.state
    index = torch.cdist(state.points, plain_hand_skin.points).argmin(-1)
    parts = plain_hand_skin.weights.argmax(-1)
    on_palm = parts[index] == 0
    towards = -(plain_hand_skin(state.pose) * plain_hand_skin.posed_normals(state.pose)).sum(-1) > 0
    assert towards[index][on_palm].float().mean() > 0.8 > 0.6 > towards[parts == 0].float().mean()


def test_velocity_predicts_what_goes_on_evenly(plain_hand, truths, tracker, frames, followed):
    _, states, _, _ = followed
    still = tracker(prediction="none")
    for state, truth in zip(states[3:6], truths[4:7], strict=True):
        ahead, held = tracker()._fitter.predicted(state, 1.0), still._fitter.predicted(state, 1.0)
        true = plain_hand.keypoints(truth)
        near, far = ((plain_hand.keypoints(pose) - true).norm(dim=-1).mean() for pose in (ahead, held))
        assert near < 0.7 * far
        assert torch.equal(held, state.pose)
    assert still.run(frames[:2]).statuses[1].usable


def test_dropped_frames_are_bridged_by_their_time(plain_hand, tracker, clouds, frames):
    kept = [0, 1, 2, 3, 6, 7]
    result = tracker().run([frames[k] for k in kept], times=[0.05 * k for k in kept])
    assert all(status.usable for status in result.statuses)
    assert tip_errors(plain_hand, result.keypoints, [clouds[k] for k in kept]).mean() < 0.003
    torch.testing.assert_close(result.times, torch.tensor([0.05 * k for k in kept], dtype=torch.float64))


def test_bad_frames_are_named_and_do_not_stop_the_tracker(plain_hand, tracker, clouds, frames):
    own = tracker()
    own.run(frames[:3])
    before = own.state.pose
    noise = own.step(noise_frame())
    assert (noise.status, noise.acquired) == (Status.LOST, "lost")
    assert not noise.status.usable
    empty = own.step(torch.zeros(0, 3))
    assert (empty.status, empty.acquired) == (Status.NO_DATA, "held")
    assert empty.inlier_ratio == 0
    assert empty.std.isnan().all()
    assert (plain_hand.keypoints(empty.pose) - plain_hand.keypoints(before)).norm(dim=-1).max() < 0.02
    assert own.step(torch.full((600, 3), torch.nan)).status is Status.NO_DATA
    with pytest.warns(UnitsWarning, match="in millimeters"):
        scaled = own.step(1000 * frames[3])
    assert (scaled.status, scaled.acquired) == (Status.OTHER_UNITS, "held")
    assert own.state.lost == 4
    good = own.step(torch.cat([frames[3], torch.full((5, 3), torch.nan)]))
    assert good.status.usable
    assert good.distances[-5:].isnan().all()
    assert not good.inliers[-5:].any()
    assert own.state.lost == 0
    assert tip_errors(plain_hand, good.keypoints[None], clouds[3:4]).mean() < 0.004


def test_held_predictions_slow_down(tracker, followed):
    _, states, _, _ = followed
    own = tracker()
    own.state = states[-1]
    steps = []
    for _ in range(6):
        before = own.state.pose
        own.step(torch.zeros(0, 3))
        steps.append(float((own.state.pose - before).norm()))
    assert steps[0] > 1e-4
    assert all(later < 0.97 * earlier for earlier, later in pairwise(steps))


def moved(pose, x):
    return torch.cat([pose[:1] + x, pose[1:]])


@pytest.fixture
def finder(monkeypatch, truths):
    """Replace the search everywhere by one that knows the truth of a frame, and tell how often it was asked."""
    calls = []

    def find(shape, data, **options):
        calls.append(len(data))
        poses = torch.stack([moved(truths[5], 0.3), truths[5], truths[5]])
        return PoseStarts(poses, torch.tensor([10.0, 11.0, 300.0]), torch.tensor(0.9))

    monkeypatch.setattr(recovery, "find_pose", find)
    return calls


def test_without_a_pose_the_first_frame_is_found(plain_hand, tracker, clouds, frames, monkeypatch, truths):
    starts = PoseStarts(truths[:1] + 0.004, torch.tensor([10.0]), torch.tensor(0.9))
    monkeypatch.setattr(recovery, "find_pose", lambda *arguments, **options: starts)
    own = tracker(None)
    result = own.run(frames[:3])
    assert result.acquired[0] == "found"
    assert result.acquired[1:] == ("tracked", "tracked")
    assert tip_errors(plain_hand, result.keypoints[1:], clouds[1:3]).mean() < 0.006


def test_what_is_nowhere_stays_unknown_and_is_sought_ever_more_rarely(tracker, monkeypatch, truths):
    calls = []

    def find(shape, data, **options):
        calls.append(own.state.frame)
        return PoseStarts(truths[:1] + 2.0, torch.tensor([300.0]), torch.tensor(0.0))

    monkeypatch.setattr(recovery, "find_pose", find)
    own = tracker(None)
    result = own.run([noise_frame(seed=k) for k in range(30)])
    assert set(result.statuses) == {Status.LOST}
    assert result.poses.isnan().all()
    assert result.keypoints.isnan().all()
    assert not own.state.found
    gaps = [later - earlier for earlier, later in pairwise(sorted(set(calls)))]
    assert gaps == sorted(gaps)
    assert gaps[-1] >= 8
    unsought = tracker(None, recovery="none")
    before = len(calls)
    assert unsought.step(noise_frame()).status is Status.LOST
    assert len(calls) == before


def test_a_lost_hand_is_found_where_it_is_nearest(plain_hand, truths, frames, tracker, followed, finder):
    """The hand vanishes for frames and comes back far away; of equally good poses the one near the last is taken."""
    _, states, _, _ = followed
    own = tracker()
    own.state = replace(states[4], pose=moved(states[4].pose, -0.4))
    records = [own.step(noise_frame(seed=k)) for k in range(3)]
    assert {record.status for record in records} == {Status.LOST}
    assert finder == []
    found = [own.step(frames[5]) for _ in range(9)]
    first = next(k for k, record in enumerate(found) if record.status.usable)
    assert found[first].acquired == "found"
    assert (found[first].keypoints - plain_hand.keypoints(truths[5])).norm(dim=-1).mean() < 0.005
    assert len(finder) >= 1


def test_fingers_that_were_missed_are_repaired_within_frames(plain_hand, truths, clouds, frames, tracker, followed):
    """With two fingers far off their data the evidence drops, and limbs are placed anew."""
    _, states, _, _ = followed
    own = tracker()
    wrong = states[4].pose.clone()
    names = plain_hand.dof_names
    for name in ("index_mcp_flexion", "middle_mcp_flexion"):
        wrong[names.index(name)] += 1.0
    own.state = replace(states[4], pose=plain_hand.clamp(wrong))
    records = [own.step(frames[number]) for number in (5, 6, 7)]
    assert {record.acquired for record in records} & {"surface", "starts", "search"}
    assert tip_errors(plain_hand, records[2].keypoints[None], clouds[7:8]).mean() < 0.004
    blind = tracker(recovery="none")
    blind.state = replace(states[4], pose=plain_hand.clamp(wrong))
    assert blind.step(frames[5]).acquired in ("tracked", "lost")


def test_more_points_than_wanted_are_thinned_but_all_are_measured(plain_hand, tracker, clouds, frames):
    own = tracker(max_points=150)
    result = [own.step(frame) for frame in frames[:3]]
    assert tip_errors(plain_hand, torch.stack([record.keypoints for record in result]), clouds[:3]).mean() < 0.008
    assert result[2].distances.isfinite().sum() > 300
    assert (result[2].inliers == clouds[2].inliers).float().mean() > 0.9
    assert result[2].posterior[clouds[2].inliers].mean() > 0.2


def test_covariance_is_that_of_repeated_measurements(arm, arm_tracking):
    """What scatters when only the noise is drawn anew, pose after pose, is what the record says."""
    truth, surface = arm_tracking.pose, arm_tracking.cloud
    config = TrackConfig(model_points="shape", recovery="none", surface_steps=3, prior_std=5.0)
    own = Tracker(arm, truth, config=config, model_points=arm_tracking.skin)
    own.step(surface)
    start, generator, poses, stds = own.state, torch.Generator().manual_seed(4), [], []
    for _ in range(60):
        own.state = replace(start, pose=truth, velocity=0 * truth)
        noise = 0.002 * torch.randn(surface.shape, generator=generator, dtype=torch.float64)
        record = own.step(surface + noise)
        poses.append(arm.difference(truth, record.pose))
        stds.append(record.std)
    scatter = torch.stack(poses).std(0)
    said = torch.stack(stds).mean(0)
    ratio = said / scatter
    assert ratio.min() > 0.75
    assert ratio.max() < 1.35


def test_covariances_are_tighter_with_more_data_and_wide_where_nothing_is_seen(followed, plain_hand):
    _, _, records, _ = followed
    record = records[-1][1]
    # The base is known to a millimeter, joints to some degrees, none better than the data allow.
    assert (record.std[:3] < 0.003).all()
    assert (record.std[6:] > 0.003).all()
    assert (record.std[6:] < 0.31).all()


def test_an_interruption_keeps_what_was_done(tracker, frames):
    def interrupted():
        yield frames[0]
        yield frames[1]
        raise KeyboardInterrupt

    assert len(tracker().run(interrupted()).poses) == 2

    def at_once():
        raise KeyboardInterrupt
        yield

    with pytest.raises(KeyboardInterrupt):
        tracker().run(at_once())


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda t: t().step(torch.zeros(5, 2)), InputError, r"points must have shape \(M, 3\), got \(5, 2\)"),
        (lambda t: t(nan_policy="raise").step(torch.full((50, 3), torch.nan)), InputError, "points must be finite"),
        (lambda t: t().step(torch.zeros(0, 3), math.nan), InputError, "time must be finite and later"),
        (lambda t: t().run([]), InputError, "frames must hold at least one cloud"),
        (lambda t: t().run([torch.zeros(0, 3)] * 2, times=[0.0]), InputError, "one entry per frame, got 1"),
        (lambda t: t(torch.zeros(26)), InputError, "initial_pose"),
        (lambda t: t(torch.full((27,), torch.nan)), InputError, "initial_pose must be finite"),
        (lambda t: setattr(t(), "state", None), InputTypeError, "state must be a TrackState, got NoneType"),
    ],
)
def test_what_cannot_be_used_is_refused(tracker, call, error, message):
    with pytest.raises(error, match=message):
        call(tracker)


def test_time_must_go_on(tracker):
    own = tracker()
    own.step(torch.zeros(0, 3), 1.0)
    own.step(torch.zeros(0, 3))
    assert own.state.time == 2.0
    with pytest.raises(InputError, match="later than the frame before at 2, got 2"):
        own.step(torch.zeros(0, 3), 2.0)


def test_skins_and_states_of_other_shapes_are_refused(arm, plain_hand_skin, tracker):
    with pytest.raises(InputError, match="model_points is a skin of another shape"):
        Tracker(arm, model_points=plain_hand_skin)
    other = Tracker(arm, config=TrackConfig(num_model_points=40))
    with pytest.raises(InputError, match="7 degrees of freedom and 2 parts"):
        other.state = tracker().state
