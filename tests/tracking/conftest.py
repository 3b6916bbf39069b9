"""A tracked arm, and a hand tracked through a sequence, that the tests of tracking share."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds
from torchreg.geometry.sampling import farthest_points

FRAMES = 8
TIPS = [4, 8, 12, 16, 20]
HINGE = 6


@pytest.fixture(scope="session")
def tracking(arm):
    """A pose of the arm, 300 points of its surface, states of its tracker, and the step from one on some data."""
    pose = torch.tensor([0.3, -0.2, 0.8, 0.4, 0.2, -0.5, 0.7], dtype=torch.float64)
    vertices = arm.surface_mesh(pose, spacing=0.01).vertices
    cloud = vertices[farthest_points(vertices, 300)]
    skin = tr.sample_skin(arm, 200)
    initial = tr.Tracker(arm, pose, model_points=skin).state

    def state(**changes):
        means = {"num_data": 300.0, "num_inliers": 300.0, "ratio_in_reach": 1.0, "residual": 0.001, "sure": True}
        motion = {"interval": 1.0, "prediction_error": 0.005, "innovation": pose.new_tensor([0.005, 0.04, 0.04])}
        return replace(initial, **{"frame": 1} | means | motion | changes)

    def step(state, points=cloud, time=None, **options):
        """Return the result of a frame and the state after it."""
        made = tr.Tracker(arm, pose, config=tr.TrackConfig(**options), model_points=skin)
        made.state = state
        return made.step(points, time), made.state

    def bent(angle):
        moved = pose.clone()
        moved[HINGE] += angle
        return moved

    return SimpleNamespace(pose=pose, cloud=cloud, skin=skin, state=state, step=step, bent=bent)


@pytest.fixture(scope="session")
def truths(plain_hand):
    return hand_motion(plain_hand, "bending_palm", FRAMES, seed=1)


@pytest.fixture(scope="session")
def clouds(plain_hand, plain_hand_surface, truths):
    return range_clouds(
        plain_hand, truths, num_points=400, outlier_ratio=0.2, camera=torch.zeros(3), skin=plain_hand_surface
    )


@pytest.fixture(scope="session")
def frames(clouds):
    return [cloud.points for cloud in clouds]


@pytest.fixture(scope="session")
def tracker(plain_hand, plain_hand_skin, truths):
    """Return a function that makes a tracker of the hand."""

    def make(initial_pose=truths[0], state=None, **config):
        made = tr.Tracker(plain_hand, initial_pose, config=tr.TrackConfig(**config), model_points=plain_hand_skin)
        made.state = state or made.state
        return made

    return make


@pytest.fixture(scope="session")
def tracked(tracker, frames):
    """A tracker after all frames, its states and results after each, and the result of the run."""
    made, records, states = tracker(), [], []

    def on_frame(points, record):
        records.append((points, record))
        states.append(made.state)

    result = made.run(frames, on_frame)
    return SimpleNamespace(tracker=made, states=states, records=records, result=result)


@pytest.fixture(scope="session")
def tip_errors(plain_hand):
    """Return a function from keypoints (T, K, 3) and T clouds to the errors of all seen fingertips, metres."""

    def errors(keypoints, clouds):
        true = torch.stack([cloud.keypoints for cloud in clouds])
        seen = torch.stack([cloud.seen_parts[list(plain_hand.fingertip_parts)] for cloud in clouds])
        return (keypoints - true).norm(dim=-1)[:, TIPS][seen]

    return errors


@pytest.fixture(scope="session")
def noise_frame():
    """Return a function that draws points all over the room in which the hand moves."""

    def draw(count=500, seed=0):
        generator = torch.Generator().manual_seed(seed)
        return torch.rand(count, 3, generator=generator) * 0.5 + torch.tensor([-0.25, -0.25, 0.3])

    return draw


@pytest.fixture
def find(monkeypatch):
    """Return a function that replaces the search everywhere by given poses and costs; it returns the calls made."""

    def replace_by(poses, costs):
        calls = []

        def found(shape, data, *, config, **keypoints):
            calls.append((len(data), config))
            chosen = poses(len(calls)) if callable(poses) else poses
            return tr.PoseStarts(chosen, torch.tensor(costs), torch.tensor(0.9, dtype=chosen.dtype))

        monkeypatch.setattr("torchreg.tracking.recovery.find_pose", found)
        return calls

    return replace_by
