"""A tracked arm that the tests of tracking share."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.skin import sample_skin
from torchreg.tracking.config import Frame, TrackConfig
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.tracker import Tracker


@pytest.fixture(scope="session")
def arm_tracking(arm):
    """A pose of the arm, 300 points of its surface there, and how to make a fitter and a state of a tracker of it."""
    pose = torch.tensor([0.3, -0.2, 0.8, 0.4, 0.2, -0.5, 0.7], dtype=torch.float64)
    vertices = arm.surface_mesh(pose, spacing=0.01).vertices
    cloud = vertices[farthest_points(vertices, 300)]
    skin = sample_skin(arm, 200)
    new = Tracker(arm, pose, model_points=skin).state

    def fitter(**options):
        return FrameFitter(arm, TrackConfig(**options), skin)

    def state(**changes):
        tracked = {
            "frame": 1,
            "num_inliers": 300.0,
            "ratio_in_reach": 1.0,
            "residual": 0.001,
            "num_data": 300.0,
            "interval": 1.0,
        }
        motion = {"prediction_error": 0.005, "innovation": pose.new_tensor([0.005, 0.04, 0.04])}
        return replace(new, **tracked | motion | changes)

    def frame(points=cloud, gap=1.0):
        return Frame(points, points.isfinite().all(-1), gap)

    return SimpleNamespace(pose=pose, cloud=cloud, skin=skin, fitter=fitter, state=state, frame=frame)
