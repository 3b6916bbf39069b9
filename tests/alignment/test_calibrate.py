"""Calibration: known lengths, radii and poses come back, the prior rules what is not seen, bad input is answered."""

import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import joint, shape_of, solid
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose
from torchreg.shapes.scale_jacobian import scale_jacobian


def make_arm(dtype=torch.float32, **options):
    """Four unlike solids with three hinges and a slide, about half a metre."""
    hinge, limits = "revolute", (-1.5, 1.5)
    joints = [
        joint("trunk", -1),
        joint("upper", 0, (0.1, 0, 0.1), hinge, (0.0, 1.0, 0.0), *limits),
        joint("lower", 1, (0, 0, 0.15), hinge, (1.0, 0.0, 0.0), *limits),
        joint("pin", 2, (0, 0, 0.12), hinge, (0.0, 1.0, 0.0), *limits),
        joint("blade", 3, (0, 0, 0.02), "prismatic", (0.0, 0.0, 1.0), -0.02, 0.05),
    ]
    solids = [
        solid("superquadric", (0.1, 0.06, 0.08, 0.6, 0.8), 0.02, 0, 0), solid("capsule", (0.06, 0.03), 0, 0, 0.07),
        solid("ellipsoid", (0.03, 0.025, 0.07), 0, 0, 0.06), solid("cone", (0.05, 0.03, 0.015), 0, 0.005, 0.05),
    ]  # fmt: skip
    return shape_of(joints, solids, ["trunk", "upper", "lower", "blade"], nu=0.006, dtype=dtype, **options)


def set_scales(shape, lengths, radii):
    with torch.no_grad():
        shape.log_length_scales.copy_(torch.as_tensor(lengths))
        shape.log_radius_scales.copy_(torch.as_tensor(radii))
    return shape


ARM_LENGTHS, ARM_RADII = (0.03, -0.06, 0.05, -0.03), (-0.04, 0.05, 0.02, 0.04)


@pytest.fixture(scope="module")
def arm():
    """An arm of other lengths and radii in four poses, noisy points of its surface with 10 % clutter, and starts."""
    truth = set_scales(make_arm(), ARM_LENGTHS, ARM_RADII).requires_grad_(False)
    generator = torch.Generator().manual_seed(3)
    poses, frames = torch.zeros(4, 10), []
    poses[:, :3] = torch.tensor([0.2, 0.1, 1.0]) + 0.05 * torch.randn(4, 3, generator=generator)
    poses[:, 3:6] = 0.5 * torch.randn(4, 3, generator=generator)
    poses[:, 6:9] = 0.6 * torch.randn(4, 3, generator=generator)
    poses[:, 9] = torch.tensor([0.0, 0.02, 0.03, -0.01])
    for pose in poses:
        points = truth.surface_mesh(pose, spacing=0.012).vertices
        points = points[torch.randperm(len(points), generator=generator)[:350]]
        points = points + 0.001 * torch.randn(points.shape, generator=generator)
        clutter = points.mean(0) + 0.5 * (torch.rand(35, 3, generator=generator) - 0.5)
        frames.append(torch.cat([points, clutter]))
    starts = poses.clone()
    starts[:, 6:9] += torch.tensor([0.15, -0.15, 0.15])
    starts[:, :3] += 0.01
    return SimpleNamespace(truth=truth, poses=poses, frames=torch.stack(frames), starts=starts)


ARM_CONFIG = tr.CalibrateConfig(align=tr.AlignConfig(search="never", num_model_points=250), rounds=1)


@pytest.fixture(scope="module")
def arm_found(arm):
    records, shape = [], make_arm()
    return shape, tr.calibrate(shape, arm.frames, arm.starts, config=ARM_CONFIG, on_step=records.append), records


def test_lengths_radii_and_poses_come_back(arm_found, arm):
    """Within a percent or two from errors of three to six."""
    _, found, _ = arm_found
    for name in ("log_length_scales", "log_radius_scales"):
        assert float((getattr(found, name) - getattr(arm.truth, name)).abs().mean()) < 0.012
        torch.testing.assert_close(getattr(found.shape, name).detach(), getattr(found, name))
    places, truth = found.shape.keypoints(found.poses).detach(), arm.truth.keypoints(arm.poses)
    assert float((places - truth).norm(dim=-1).mean()) < 0.002
    assert found.status in (tr.Status.CONVERGED, tr.Status.MAX_STEPS)
    assert found.cost.shape == ()


def test_the_given_shape_is_not_changed_and_records_end_with_the_result(arm_found, arm):
    shape, found, records = arm_found
    assert float(shape.log_length_scales.detach().abs().max()) == 0.0
    assert found.shape is not shape
    assert not any(parameter.requires_grad for parameter in found.shape.parameters())
    assert [(record.round, record.step, record.num_steps) for record in records] == [(0, 0, 3), (0, 1, 3), (0, 2, 3)]
    sigmas = [record.sigma for record in records]
    assert sigmas == sorted(sigmas, reverse=True)
    for name in ("poses", "log_length_scales", "log_radius_scales", "cost"):
        torch.testing.assert_close(torch.as_tensor(getattr(records[-1], name)), getattr(found, name))
    learning = make_arm()
    learning.log_length_scales.requires_grad_(True)
    copied = tr.calibrate(learning, arm.frames[:1], arm.starts[:1], config=ARM_CONFIG).shape
    learnt = [name for name, parameter in copied.named_parameters() if parameter.requires_grad]
    assert learnt == ["log_length_scales"]


def test_a_sequence_of_clouds_is_one_tensor_with_a_mask(arm):
    """Clouds of unlike sizes; what padding holds does not matter; thinning keeps every second point."""
    clouds = [frame[: 385 - 40 * number] for number, frame in enumerate(arm.frames)]
    listed = tr.calibrate(make_arm(), clouds, arm.starts, config=ARM_CONFIG)
    padded = torch.nn.utils.rnn.pad_sequence(clouds, batch_first=True, padding_value=math.nan)
    masked = tr.calibrate(make_arm(), padded, arm.starts, masks=~padded[..., 0].isnan(), config=ARM_CONFIG)
    torch.testing.assert_close(listed.poses, masked.poses)
    torch.testing.assert_close(listed.log_length_scales, masked.log_length_scales)
    thinned = tr.CalibrateConfig(align=ARM_CONFIG.align, rounds=1, max_points=200)
    few = tr.calibrate(make_arm(), arm.frames, arm.starts, config=thinned)
    assert float((few.log_length_scales - listed.log_length_scales).abs().max()) < 0.03


def test_a_frame_that_shows_something_else_does_not_count_also_far_away(arm, arm_found):
    away = torch.tensor([300.0, -200.0, 100.0])
    generator = torch.Generator().manual_seed(6)
    clutter = arm.starts[:1, :3] + torch.tensor([0.0, 0.0, 2.0]) + torch.rand(385, 3, generator=generator)
    starts = torch.cat([arm.starts, arm.starts[:1]])
    starts[:, :3] += away
    found = tr.calibrate(make_arm(), torch.cat([arm.frames, clutter.unsqueeze(0)]) + away, starts, config=ARM_CONFIG)
    assert found.status is tr.Status.FEW_INLIERS
    torch.testing.assert_close(found.log_length_scales, arm_found[1].log_length_scales, rtol=0, atol=3e-3)
    torch.testing.assert_close(found.poses[:4, :3] - away, arm_found[1].poses[:, :3], rtol=0, atol=1e-3)
    torch.testing.assert_close(found.poses[:4, 3:], arm_found[1].poses[:, 3:], rtol=0, atol=5e-3)


def test_the_prior_rules_what_is_not_seen(arm):
    """All parts are 8 % larger, but the blade is never seen: it takes the common scale of the others."""
    larger = set_scales(make_arm(), [0.08] * 4, [0.08] * 4).requires_grad_(False)
    frames = []
    for pose in arm.poses:
        points = larger.surface_mesh(pose, spacing=0.012).vertices
        frames.append(points[larger.part_distances(points, pose).argmin(-1) != 3][:400])
    found = tr.calibrate(make_arm(), frames, arm.starts, config=ARM_CONFIG)
    assert float(found.log_length_scales[3]) == pytest.approx(0.08, abs=0.03)
    assert float(found.log_radius_scales[3]) == pytest.approx(0.08, abs=0.03)
    stiff = tr.CalibrateConfig(align=ARM_CONFIG.align, rounds=1, size_std=1e-4, radius_std=1e-4, part_std=1e-4)
    held = tr.calibrate(make_arm(), frames, arm.starts, config=stiff)
    assert float(held.log_length_scales.abs().max()) < 2e-3


def test_a_bolted_machine_in_double_precision():
    shape = make_arm(torch.float64, free_base=False)
    truth = set_scales(make_arm(torch.float64, free_base=False), ARM_LENGTHS, ARM_RADII).requires_grad_(False)
    poses = torch.zeros(2, 10).double()
    poses[:, 6:9] = torch.tensor([[0.4, -0.5, 0.6], [-0.6, 0.5, 0.2]])
    frames = [truth.surface_mesh(pose, spacing=0.015).vertices for pose in poses]
    found = tr.calibrate(shape, frames, 0.8 * poses, config=ARM_CONFIG)
    assert found.poses.dtype == found.log_length_scales.dtype == torch.float64
    assert bool((found.poses[:, :6] == 0).all())
    assert float((found.log_radius_scales - truth.log_radius_scales).abs().mean()) < 0.015


@pytest.mark.parametrize("kind", ["arm", "hand"])
def test_scale_jacobian_matches_differences(kind):
    """Every kind of solid; every length moves the parts that hang on it."""
    generator = torch.Generator().manual_seed(7)
    shape = make_arm(torch.float64) if kind == "arm" else tr.Hand(dtype=torch.float64)
    scales = 0.1 * torch.randn(2, shape.num_parts, generator=generator).double()
    set_scales(shape, *scales)
    poses = 0.4 * torch.randn(2, shape.num_dofs, generator=generator).double()
    points = shape.keypoints(poses).detach().repeat(1, 3, 1)
    points = points + 0.03 * torch.randn(points.shape, generator=generator).double()
    found = scale_jacobian(shape, points, poses)
    columns = []
    for axis in 1e-6 * torch.eye(2 * shape.num_parts, dtype=torch.float64):
        values = []
        for sign in (1, -1):
            set_scales(shape, *(scales + sign * axis.view_as(scales)))
            values.append(shape.distance(points, poses).detach())
        columns.append((values[0] - values[1]) / 2e-6)
    assert not found.requires_grad
    torch.testing.assert_close(found, torch.stack(columns, dim=-1), rtol=0, atol=1e-8)


def test_a_hand_of_another_size_is_searched_in_clouds_and_what_shows_none_is_left_out(plain_hand):
    """The first two frames show a smaller hand, turned otherwise in each, the third a box."""
    truth = set_scales(tr.Hand(), [math.log(0.88)] * 16, [math.log(0.88)] * 16).requires_grad_(False)
    poses = torch.stack([random_hand_pose(truth, torch.Generator().manual_seed(seed), bend=0.3) for seed in (20, 21)])
    generator = torch.Generator().manual_seed(0)
    clouds = [make_hand_cloud(truth, pose, num_points=600, outlier_ratio=0.0, generator=generator).points
              for pose in poses]  # fmt: skip
    box = torch.rand(600, 3, generator=generator)
    box.scatter_(1, torch.randint(3, (600, 1), generator=generator), (box[:, :1] > 0.5).float())
    with pytest.warns(tr.errors.FramesWarning, match="not surely found in frames 2 of 3, counted from 0"):
        found = tr.calibrate(plain_hand, [*clouds, 0.15 * box])
    assert (found.status, found.outliers) == (tr.Status.WITH_WARNINGS, (2,))
    assert float(found.log_length_scales.exp().mean()) == pytest.approx(0.88, abs=0.03)
    off = found.shape.keypoints(found.poses[:2]).detach() - truth.keypoints(poses)
    assert float(off.norm(dim=-1).mean()) < 0.004


def test_without_any_frame_that_can_be_trusted_the_result_is_doubtful(plain_hand):
    cloud = 0.05 * torch.randn(150, 3, generator=torch.Generator().manual_seed(0))
    with pytest.warns(tr.errors.FramesWarning, match="frames 0 of 1"):
        found = tr.calibrate(plain_hand, [cloud], config=tr.CalibrateConfig(rounds=1))
    assert not found.status.usable
