"""How far poses are known: covariances against repeated measurements, with more data and with none."""

from dataclasses import replace

import torch

import torchreg as tr
from torchreg.geometry.rigid import transform_points

HINGE = 6


def test_covariance_is_that_of_repeated_measurements(arm, tracking):
    """What scatters when only the noise is drawn anew, pose after pose, is what the result says."""
    truth, surface = tracking.pose, tracking.cloud
    config = tr.TrackConfig(model_points="shape", recovery="none", surface_steps=3, prior_std=5.0)
    tracker = tr.Tracker(arm, truth, config=config, model_points=tracking.skin)
    tracker.step(surface)
    start, generator, poses, stds = tracker.state, torch.Generator().manual_seed(4), [], []
    for _ in range(60):
        tracker.state = replace(start, pose=truth, velocity=0 * truth)
        noise = 0.002 * torch.randn(surface.shape, generator=generator, dtype=torch.float64)
        record = tracker.step(surface + noise)
        poses.append(arm.difference(truth, record.pose))
        stds.append(record.std)
    ratio = torch.stack(stds).mean(0) / torch.stack(poses).std(0)
    assert ratio.min() > 0.75
    assert ratio.max() < 1.35


def test_a_hand_is_known_to_millimeters_and_some_degrees(tracked):
    for _, record in tracked.records:
        assert record.covariance.shape == (27, 27)
        torch.testing.assert_close(record.std, record.covariance.diagonal().sqrt())
        assert (torch.linalg.eigvalsh(record.covariance.double()) > 0).all()
    # No joint is known better than the data allow.
    assert (record.std[:3] < 0.003).all()
    assert (record.std[6:] > 0.003).all()
    assert (record.std[6:] < 0.31).all()


def test_limbs_that_no_data_show_stay_at_their_prediction_and_are_uncertain(arm, tracking):
    body, hinged = (arm.distance(tracking.cloud, tracking.pose, parts=[part]).abs() for part in (0, 1))
    # Five outliers beside the arm would attract it.
    tip = transform_points(arm.part_transforms(tracking.pose)[1], torch.tensor([[0.25, 0.0, 0.045]]).double())
    outliers = tip + 0.001 * torch.arange(5.0).double().unsqueeze(-1)
    cloud = torch.cat([tracking.cloud[body + 0.004 < hinged], outliers])
    hidden, _ = tracking.step(tracking.state(num_inliers=float(len(cloud))), cloud)
    shown, _ = tracking.step(tracking.state())
    assert hidden.pose[HINGE] == tracking.pose[HINGE]
    # 150 data with a lever of some 0.15 m tell the hinge to half a degree.
    assert shown.std[HINGE] < 0.01 < 0.02 < hidden.std[HINGE]
