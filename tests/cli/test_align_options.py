"""What commands that fit shapes have in common: schedules, clouds in their unit, poses by name, the line they print."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchreg.alignment.results import AlignResult
from torchreg.alignment.sigma_schedule import SigmaSchedule
from torchreg.cli.align_options import alignment_summary, person_summary, read_cloud, read_schedule, write_pose
from torchreg.errors import FormatError, InputError
from torchreg.io.points import save_points
from torchreg.result import Status


def test_schedules_are_start_stop_steps():
    assert read_schedule(None) is None
    assert read_schedule("0.02:0.005:3") == SigmaSchedule.geometric(0.02, 0.005, 3)
    for text in ("0.02", "0.02:0.005", "a:b:c", "0.02:0.005:2.5", "1:2:3:4", ""):
        with pytest.raises(InputError, match=r"--sigma must be START:STOP:STEPS as in 0\.02:0\.005:5, got "):
            read_schedule(text)
    with pytest.raises(InputError, match="stop must not exceed start"):
        read_schedule("0.01:0.02:5")


def test_clouds_are_read_in_their_unit(tmp_path):
    points = torch.tensor([[100.0, 0.0, -250.0], [0.0, 50.0, 0.0]])
    save_points(tmp_path / "mm.ply", points)
    torch.testing.assert_close(read_cloud(tmp_path / "mm.ply", 0.001, "raise"), points / 1000)
    for scale in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(InputError, match="--scale must be positive and finite"):
            read_cloud(tmp_path / "mm.ply", scale, "raise")


def test_points_that_are_not_finite_follow_the_policy(tmp_path):
    (tmp_path / "c.xyz").write_text("nan 0 0\n1 2 3\n", encoding="utf-8")
    assert read_cloud(tmp_path / "c.xyz", 1.0, "omit").tolist() == [[1.0, 2.0, 3.0]]
    with pytest.raises(FormatError, match="1 of 2 points are not finite"):
        read_cloud(tmp_path / "c.xyz", 1.0, "raise")


def test_poses_are_written_by_name(plain_hand, tmp_path):
    pose = torch.arange(27.0) / 8
    write_pose(tmp_path / "pose.json", plain_hand, pose)
    named = json.loads((tmp_path / "pose.json").read_text(encoding="utf-8"))
    assert list(named) == list(plain_hand.dof_names)
    assert list(named.values()) == pose.tolist()


def test_the_summary_counts_inliers_and_tells_their_distance():
    distances = torch.tensor([0.003, -0.004, 0.1])
    common = {
        "pose": torch.zeros(27), "registered": torch.zeros(4, 3), "keypoints": torch.zeros(21, 3),
        "distances": distances, "posterior": torch.zeros(3), "sigma": torch.tensor(0.005), "cost": torch.tensor(12.5),
    }  # fmt: skip
    found = AlignResult(inliers=distances.abs() < 0.01, status=Status.CONVERGED, **common)
    assert alignment_summary(found) == "converged, 2 of 3 points inliers, rms 3.54 mm, cost 12.5"
    lost = AlignResult(inliers=torch.zeros(3, dtype=torch.bool), status=Status.FEW_INLIERS, **common)
    assert alignment_summary(lost) == f"{Status.FEW_INLIERS.value}, 0 of 3 points inliers, cost 12.5"


def test_people_are_told_by_their_coefficients():
    value, none = torch.zeros(()), torch.zeros(0)
    plain = AlignResult(none, none, none, none, none, none, value, value, Status.CONVERGED)
    fitted = replace(
        plain, coefficients=torch.tensor([0.25, 1.5]), coefficient_covariance=torch.tensor([0.01, 0.04]).diag()
    )
    shape = SimpleNamespace(coefficient_names=("age", "height"))
    assert person_summary(shape, plain) == ""
    assert person_summary(shape, fitted) == "age 0.25 +- 0.10, height 1.50 +- 0.20"
