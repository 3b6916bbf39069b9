"""How far alignments can be trusted: covariance, convergence, confidence, and doubts in words."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

import torchreg as tr
from tests.alignment.conftest import DESCENT
from tests.alignment.made import joint, shape_of, solid
from torchreg.alignment.evidence.confidence import SurfaceResiduals, doubled_data, end_spreads, overlap
from torchreg.alignment.evidence.coverage import unseen_share
from torchreg.alignment.evidence.curvature import correlated_count, neighbor_correlation
from torchreg.alignment.evidence.reliability import CALIBRATION, EVIDENCE_NAMES
from torchreg.alignment.fit.problem import centered_problem
from torchreg.datasets.hand import surface_skin
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.visibility import visible_points

FREE = tr.AlignConfig(search="never", prior_std=None)


def noise_of(*shape, seed=0, std=0.001, dtype=torch.float32):
    return std * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_independent_residuals_count_each_and_smooth_ones_together():
    steps = torch.arange(30, dtype=torch.float64)
    data = torch.stack([*torch.meshgrid(steps, steps, indexing="ij"), torch.zeros(30, 30)], dim=-1).reshape(1, -1, 3)
    noise = torch.randn(1, 900, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ones = torch.ones(1, 900, dtype=torch.float64)
    smooth = torch.nn.functional.avg_pool2d(noise.reshape(1, 30, 30), 3, 1, 1).reshape(1, 900)
    plain, nine, all_ = (float(correlated_count(neighbor_correlation(data, residual, ones)))
                         for residual in (noise, smooth, ones))  # fmt: skip
    assert plain == pytest.approx(1, abs=0.4)
    # A mean of nine values is correlated with its neighbors as boxes overlap: the sum of all correlations is 9.
    assert nine == pytest.approx(9, rel=0.5)
    assert all_ > 50


@pytest.fixture(scope="module")
def measured(links, links_skin):
    """A pose of the links, and their points there with 2 mm noise."""
    pose = links.rest_pose()
    pose[6:] = torch.tensor([0.4, -0.3])
    return pose, links_skin(pose) + noise_of(300, std=0.002, dtype=torch.float64)


def test_evidence_is_none_at_the_truth_and_speaks_against_a_wrong_pose(links, links_skin, measured):
    pose, data = measured
    right = tr.align(links, data, pose, model_points=links_skin, config=DESCENT)
    wrong_pose = pose.clone()
    wrong_pose[6] = -0.8
    locked = links.dof_names
    wrong = tr.align(links, data, wrong_pose, model_points=links_skin, locked=locked, config=DESCENT)
    assert right.status is tr.Status.CONVERGED
    assert float(right.evidence[3]) < 0.1 < 0.4 < float(wrong.evidence[3])  # off the surface
    assert float(right.confidence) > 0.9 > 0.5 > float(wrong.confidence)


def test_surface_without_data_counts_as_unseen_where_a_camera_would_see_it(plain_hand):
    """Beside visibility by rasterizing: half a cloud misses what it would show."""
    skin, pose = surface_skin(plain_hand), plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.0, 0.0, 0.8, 0.4, 2.0, -0.3])
    mesh = tr.TriangleMesh(skin(pose), skin.faces)
    seen = visible_points(mesh, mesh.vertices, torch.zeros(3))
    data = mesh.vertices[seen]
    above = data[:, 0] > data[:, 0].median()
    clouds = torch.stack([data, torch.where(above.unsqueeze(-1), data, torch.nan)])
    valid = torch.stack([torch.ones_like(above), above])
    poses = pose.expand(2, -1)
    problem = centered_problem(
        skin, clouds.nan_to_num(), valid, poses, torch.zeros(2, 3), prior_std=None, pose_atol=0.0
    )  # fmt: skip
    residuals = SurfaceResiduals.of(problem, poses)
    shares = unseen_share(problem, poses, residuals.distance, residuals.jacobian, -normalize(skin(poses), dim=-1))
    far = torch.cdist(data, data[above]).amin(-1) > 0.04 * problem.size
    assert float(shares[0]) < 0.01
    assert float(shares[1]) == pytest.approx(float(far.float().mean()), abs=0.05)
    alone = replace(residuals, distance=residuals.distance[1:], jacobian=residuals.jacobian[1:])
    row = problem.rows(torch.tensor([1]))
    assert torch.equal(
        unseen_share(row, poses[1:], alone.distance, alone.jacobian),
        unseen_share(problem, poses, residuals.distance, residuals.jacobian)[1:],
    )


def test_what_is_hidden_and_what_rivals_a_pose_lower_its_confidence_in_proportion():
    evidence = torch.zeros(4, len(EVIDENCE_NAMES), dtype=torch.float64)
    evidence[1, EVIDENCE_NAMES.index("unknown")] = 0.4
    evidence[2, EVIDENCE_NAMES.index("rival")] = 1.0
    evidence[3, EVIDENCE_NAMES.index("overlap")] = 1.0
    found, hidden, tied, overlapping = CALIBRATION.probability(evidence).tolist()
    assert found > 0.99
    assert hidden == pytest.approx(0.6 * found)
    assert tied == 0
    odds = CALIBRATION.bias - CALIBRATION.weights[EVIDENCE_NAMES.index("overlap")]
    assert overlapping == pytest.approx(1 / (1 + math.exp(-odds)))


def test_a_hidden_finger_spreads_by_its_own_joint_not_by_that_of_the_arm():
    joints = [joint("body", -1), joint("arm", 0, (0, 0, 0), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5)]
    joints += [joint(name, 1, (0, place, 0.3), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5)
               for name, place in (("shown", -0.03), ("hidden", 0.03))]  # fmt: skip
    solids = [solid("ellipsoid", (0.05, 0.04, 0.06)), solid("ellipsoid", (0.03, 0.02, 0.15), 0, 0, 0.15)]
    solids += [solid("ellipsoid", (0.008, 0.008, 0.03), 0, 0, 0.03)] * 2
    shape = shape_of(joints, solids, nu=0.003, dtype=torch.float64)
    skin, pose = tr.sample_skin(shape, 600), shape.rest_pose()[None]
    part, spreads = skin.weights.argmax(-1), []
    for shown in (part < 3, part < 1):
        data = (skin(pose)[0] + noise_of(len(skin), dtype=torch.float64))[shown][None]
        problem = centered_problem(
            skin, data, torch.ones(1, data.shape[1], dtype=torch.bool), pose, torch.zeros(1, 3, dtype=torch.float64),
            prior_std=0.5, pose_atol=0.0,
        )  # fmt: skip
        spreads.append(end_spreads(problem, pose)[0])
    assert float(spreads[0][:2].max()) < 0.005
    # A finger of 6 cm that turns by half a radian, on an arm of 30 cm that may as well.
    assert 0.01 < float(spreads[0][2]) < 0.06
    assert float(spreads[1][2]) > 0.1


def test_limbs_in_each_other_overlap_and_explain_data_twice():
    """Two equal fingers on one hinge of a palm lie apart at rest, half in each other, and at one place."""
    joints = [joint("palm", -1), *(joint(name, 0, (0, 0, 0), "revolute", (1.0, 0.0, 0.0), *sorted((side, 2 * side)))
                                   for name, side in (("near", -0.8), ("far", 0.8)))]  # fmt: skip
    solids = [solid("ellipsoid", (0.03, 0.03, 0.02)), *[solid("ellipsoid", (0.01, 0.01, 0.06), 0, 0, 0.09)] * 2]
    shape = shape_of(joints, solids, nu=0.003, dtype=torch.float64)
    skin, turns = tr.sample_skin(shape, 400), torch.tensor([0.8, 0.1, 0.0], dtype=torch.float64)
    pose = torch.cat([shape.rest_pose()[:6].expand(3, 6), -turns[:, None], turns[:, None]], dim=1)
    data = skin(pose) + noise_of(3, len(skin), dtype=torch.float64)
    problem = centered_problem(
        skin, data, torch.ones(3, len(skin), dtype=torch.bool), pose, torch.zeros(3, 3, dtype=torch.float64),
        prior_std=None, pose_atol=0.0,
    )  # fmt: skip
    shares, part = overlap(problem, pose), skin.weights.argmax(-1)
    assert bool((shares[0] == 0).all() & (shares[1] > 0.1).all() & (shares[1] < shares[2]).all())
    # All of a finger but what the palm explains anyhow.
    assert float(shares[2].min()) > 0.8
    assert torch.allclose(shares[:, 0], shares[:, 1], atol=0.05)
    assert torch.allclose(overlap(problem.rows(torch.tensor([2])), pose[2:]), shares[2:])
    expected = (shares * torch.stack([(part == finger).sum() for finger in (1, 2)])).sum(-1) / 2
    assert torch.allclose(doubled_data(problem, pose), expected, rtol=0.1)


def test_a_fit_goes_on_where_another_step_would_gain(links, links_skin, measured):
    pose, data = measured
    schedule = tr.SigmaSchedule.geometric(0.06, 0.05, 1)
    start, found = links.retract(pose, 0.12 * torch.ones_like(pose)), {}
    for search in ("never", "auto"):
        config = tr.AlignConfig(search=search, schedule=schedule, em_steps=1, surface_steps=1, pose_atol=1e-9)
        found[search] = tr.align(links, data, start, model_points=links_skin, config=config)
    assert found["never"].status is tr.Status.MAX_STEPS
    assert found["auto"].status is tr.Status.CONVERGED


def test_the_covariance_is_that_of_repeated_measurements_and_of_other_proportions(links, links_skin, measured):
    pose, _ = measured
    clouds = links_skin(pose) + noise_of(24, 300, seed=1, std=0.002, dtype=torch.float64)
    found = tr.align(links, clouds, pose.expand(24, -1), model_points=links_skin, config=FREE)
    spread = found.pose[:, 6:].std(0)
    told = found.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()[6:]
    assert bool((told > 0.6 * spread).all() & (told < 4 * spread).all())
    generator, other, clouds = torch.Generator().manual_seed(2), copy.deepcopy(links), []
    with torch.no_grad():
        for _ in range(24):
            for scales in (other.log_length_scales, other.log_radius_scales):
                scales.copy_(0.05 * torch.randn(scales.shape, generator=generator, dtype=scales.dtype))
            vertices = other.surface_mesh(pose, spacing=0.012).vertices
            clouds.append(vertices[farthest_points(vertices, 300)])
    found = tr.align(links, torch.stack(clouds), pose.expand(24, -1), model_points=links_skin, config=FREE)
    off = links.difference(pose.expand(24, -1), found.pose)
    squares = (off * torch.linalg.solve(found.covariance, off.unsqueeze(-1)).squeeze(-1)).sum(-1)
    assert 0.4 < float(squares.mean()) / len(pose) < 1.6
    # So do the variances alone.
    told = found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert float(off.square().sum(-1).mean()) == pytest.approx(float(told.mean()), rel=0.6)


def test_one_datum_on_a_handle_tells_no_turn_surely():
    """Of a round knob it alone would tell how far it is turned, and may be there by chance; ten tell."""
    joints = [joint("base", -1), joint("knob", 0, (0, 0, 0), "revolute", (0.0, 0.0, 1.0), -3.0, 3.0),
              joint("handle", 1)]  # fmt: skip
    solids = [
        solid("ellipsoid", (0.05, 0.08, 0.06)), solid("ellipsoid", (0.07, 0.07, 0.04), 0, 0, 0.1),
        solid("ellipsoid", (0.04, 0.01, 0.01), 0.1, 0, 0.1),
    ]  # fmt: skip
    shape = shape_of(joints, solids, nu=0.003, dtype=torch.float64)
    skin, pose = tr.sample_skin(shape, 600), shape.rest_pose()
    data = skin(pose) + noise_of(len(skin), dtype=torch.float64)
    on_handle = data[:, 0] > 0.1

    def std(count):
        seen = torch.cat((data[~on_handle & (data[:, 0] < 0.06)], data[on_handle][:count]))
        found = tr.align(shape, seen, pose, model_points=skin, config=DESCENT)
        return float(found.covariance[6, 6].sqrt())

    assert std(1) > 0.5 * std(0)
    assert std(10) < 0.2 * std(0)


ROBOT = """<robot name="arm"><link name="base"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual></link>
{}{}</robot>"""
LINK = """<link name="{0}"><visual><origin xyz="0 0 0.15"/><geometry>{1}</geometry></visual></link>
<joint name="{2}" type="{3}"><parent link="{4}"/><child link="{0}"/><origin xyz="0 0 {5}"/>
<axis xyz="{6}"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>"""
BOX, CYLINDER = '<box size="0.06 0.09 0.3"/>', '<cylinder radius="0.05" length="0.3"/>'


@pytest.mark.parametrize(("solid", "kind", "seen", "is_open"), [
    (BOX, "revolute", True, False), (CYLINDER, "revolute", True, True), (CYLINDER, "continuous", True, True),
    (BOX, "continuous", False, True),
])  # fmt: skip
def test_joints_that_no_data_determine_are_named_whatever_the_status(tmp_path, solid, kind, seen, is_open):
    """The turn of a cylinder about its own axis, which has the facets of a mesh, and that of a missing link."""
    upper = LINK.format("upper", BOX, "lift", "revolute", "base", 0.05, "0 1 0")
    (tmp_path / "arm.urdf").write_text(
        ROBOT.format(upper, LINK.format("tool", solid, "roll", kind, "upper", 0.3, "0 0 1"))
    )
    arm = tr.ArticulatedShape.from_urdf(tmp_path / "arm.urdf", free_base=False)
    pose = arm.pose_from_dict({"lift": 0.6, "roll": 0.4})
    skin = tr.sample_skin(arm, 900)
    kept = torch.ones(len(skin), dtype=torch.bool) if seen else skin.weights.argmax(-1) < 2
    data = skin(pose)[kept] + noise_of(int(kept.sum()))
    found = tr.align(arm, data, pose, config=DESCENT)
    assert ("not determined by the data: roll (+- " in found.doubt) is is_open
    assert "lift (" not in found.doubt
    # Without data the standard deviation is a radian, as the limits are wider than that of it.
    assert found.named_std["roll"] == pytest.approx(1.0, rel=0.1) if is_open else found.named_std["roll"] < 0.1
    assert found.named_std["lift"] < 0.05
    confidence = dict(zip(arm.dof_names, found.dof_confidence.tolist(), strict=True))
    assert (confidence["roll"] < 0.2, confidence["lift"] > 0.99, confidence["base_x"]) == (is_open, True, 1.0)
    held = tr.align(arm, data, pose, locked=["roll"], config=DESCENT)
    assert "roll" not in held.doubt
    assert held.dof_confidence[-1] > 0.99


def test_the_more_fingers_are_without_data_the_lower_is_the_confidence(plain_hand, plain_hand_skin):
    pose, part = plain_hand.rest_pose(), plain_hand_skin.weights.argmax(-1)
    pose[3:6], pose[6:] = torch.tensor([2.9, 0.3, -0.4]), 0.2 * plain_hand.upper[6:].clamp_min(0)
    clouds = (plain_hand_skin(pose) + noise_of(400)).expand(4, -1, -1)
    hidden = torch.tensor([[number in range(tip - 2, tip + 1) for number in range(16)]
                           for tip in plain_hand.fingertip_parts])  # fmt: skip
    mask = torch.stack([~hidden[:count].any(0)[part] for count in range(4)])
    found = tr.align(plain_hand, clouds, pose, mask=mask, model_points=plain_hand_skin, config=DESCENT)
    assert bool((found.confidence.diff() < 0).all())
    assert found.confidence[0] > 0.9
    assert "hardly any data show where thumb, index end" in found.doubt[2]
    assert not any(words in found.doubt[0] for words in ("hardly any data", "determined"))
    assert list(found.named_std) == list(found.named_pose)
    assert found.named_std["little_dip_flexion"].shape == (4,)
    assert bool((found.dof_confidence[0] > 0.5).all())
    # A tighter prior knows more of what is hidden, and clouds of a batch are each as alone.
    tight = tr.align(plain_hand, clouds[3], pose, mask=mask[3], model_points=plain_hand_skin,
                     config=tr.AlignConfig(search="never", prior_std=0.03))  # fmt: skip
    assert float(tight.confidence) > float(found.confidence[3])
    alone = tr.align(plain_hand, clouds[3], pose, mask=mask[3], model_points=plain_hand_skin, config=DESCENT)
    assert float(alone.confidence) == pytest.approx(float(found.confidence[3]), abs=0.02)


def test_hidden_ends_spread_as_the_prior_does():
    """One hinge without data: its end lies within 4 % of the size as often as in draws from the prior."""
    joints = [joint("body", -1), joint("arm", 0, (0, 0, 0), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5)]
    solids = [solid("ellipsoid", (0.05, 0.03, 0.06)), solid("ellipsoid", (0.01, 0.01, 0.05), 0, 0, 0.15)]
    shape = shape_of(joints, solids, nu=0.004)
    skin, pose = tr.sample_skin(shape, 300), shape.rest_pose()
    size, lever = (skin.points.amax(0) - skin.points.amin(0)).norm(), skin.points[:, 1:].norm(dim=-1).max()
    body, sources = skin(pose)[skin.weights.argmax(-1) == 0], [lambda *_: pose[None, None]]
    for std in (0.03, 0.05):
        config = tr.FindPoseConfig(num_candidates=1, num_placed=1, num_searched=1, prior_std=std)
        found = tr.find_pose(shape, body, sources=sources, model_points=skin, locked="base", config=config)
        expected = 1 - math.exp(-(float(0.04 * size / (lever * std)) ** 2))
        assert float(found.confidence) == pytest.approx(expected, rel=0.1)
