"""How far alignments can be trusted: what residuals share, covariance, confidence, and doubts in words."""

import copy

import pytest
import torch

import torchreg as tr
from tests.alignment.made import joint, problem_of, shape_of, solid
from torchreg.alignment.evidence.curvature import correlated_count, curvature, neighbor_correlation
from torchreg.alignment.evidence.reliability import judge
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.pose_algebra import difference


def lattice(count=30):
    steps = torch.arange(count, dtype=torch.float64)
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack((rows, columns, 0 * rows), dim=-1).reshape(1, -1, 3)


def correlated(data, residual, weight):
    return correlated_count(neighbor_correlation(data, residual, weight))


def test_independent_residuals_count_each_and_smooth_ones_together():
    data, generator = lattice(), torch.Generator().manual_seed(0)
    noise = torch.randn(1, 900, generator=generator, dtype=torch.float64)
    ones = torch.ones(1, 900, dtype=torch.float64)
    assert float(correlated(data, noise, ones)) == pytest.approx(1, abs=0.4)
    smooth = torch.nn.functional.avg_pool2d(noise.reshape(1, 30, 30), 3, 1, 1).reshape(1, 900)
    # A mean of nine values is correlated with its neighbors as boxes overlap: the sum of all correlations is 9.
    assert float(correlated(data, smooth, ones)) == pytest.approx(9, rel=0.5)
    assert float(correlated(data, ones, ones)) > 50


@pytest.fixture(scope="module")
def measured(links, links_skin):
    """Points of the links in a pose, 2 mm noise, and their alignment in the pose's coordinates."""
    pose = links.rest_pose()
    pose[6:] = torch.tensor([0.4, -0.3])
    generator = torch.Generator().manual_seed(0)
    data = links_skin(pose) + 0.002 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    return pose, data


def test_evidence_is_none_at_the_truth_and_speaks_against_a_wrong_pose(links, links_skin, measured):
    pose, data = measured
    problem = problem_of(links_skin, data[None], pose[None], prior_std=0.3, pose_atol=1e-3)
    right = judge(problem, pose[None], None)
    wrong_pose = pose.clone()
    wrong_pose[6] = -0.8
    wrong = judge(problem, wrong_pose[None], pose.new_tensor([0.0]))
    assert float(right.evidence.off) < 0.1
    assert float(wrong.evidence.off) > 0.4
    assert float(wrong.evidence.rival) == 1
    assert float(right.evidence.rival) == 0
    assert float(right.confidence) > float(wrong.confidence)


def test_a_fit_has_converged_where_another_step_gains_nothing(links, links_skin, measured):
    pose, data = measured
    found = tr.align(links, data, pose, model_points=links_skin, config=tr.AlignConfig(search="never"))
    assert found.status is tr.Status.CONVERGED
    problem = problem_of(links_skin, data[None], pose[None], prior_std=0.3, pose_atol=1e-3)
    assert bool(curvature(problem, found.pose[None]).converged)
    off = links.retract(found.pose[None], torch.full_like(pose[None], 0.02))
    assert not bool(curvature(problem, off).converged)


def test_a_fit_goes_on_where_another_step_would_gain(links, links_skin, measured):
    pose, data = measured
    schedule = tr.SigmaSchedule.geometric(0.06, 0.05, 1)
    start, found = links.retract(pose, 0.12 * torch.ones_like(pose)), {}
    for search in ("never", "auto"):
        config = tr.AlignConfig(search=search, schedule=schedule, em_steps=1, surface_steps=1, pose_atol=1e-9)
        found[search] = tr.align(links, data, start, model_points=links_skin, config=config)
    assert found["never"].status is tr.Status.MAX_STEPS
    assert found["auto"].status is tr.Status.CONVERGED


def test_the_covariance_is_that_of_repeated_measurements(links, links_skin, measured):
    pose, _ = measured
    generator = torch.Generator().manual_seed(1)
    noise = 0.002 * torch.randn(24, 300, 3, generator=generator, dtype=torch.float64)
    clouds = links_skin(pose) + noise
    config = tr.AlignConfig(search="never", prior_std=None)
    found = tr.align(links, clouds, pose.expand(24, -1), model_points=links_skin, config=config)
    spread = found.pose[:, 6:].std(0)
    told = found.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()[6:]
    assert bool((told > 0.6 * spread).all())
    assert bool((told < 4 * spread).all())


def test_one_datum_on_a_handle_tells_no_turn_surely():
    """Of a round knob it alone would tell how far it is turned, and may be there by chance; ten tell."""
    joints = [
        joint("base", -1), joint("knob", 0, (0, 0, 0), "revolute", (0.0, 0.0, 1.0), -3.0, 3.0), joint("handle", 1),
    ]  # fmt: skip
    solids = [
        solid("ellipsoid", (0.05, 0.08, 0.06)), solid("ellipsoid", (0.07, 0.07, 0.04), 0, 0, 0.1),
        solid("ellipsoid", (0.04, 0.01, 0.01), 0.1, 0, 0.1),
    ]  # fmt: skip
    shape = shape_of(joints, solids, nu=0.003, dtype=torch.float64)
    skin = tr.sample_skin(shape, 600)
    pose = shape.rest_pose()
    noise = 0.001 * torch.randn(len(skin), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = skin(pose) + noise
    on_handle = data[:, 0] > 0.1

    def std(count):
        seen = torch.cat((data[~on_handle & (data[:, 0] < 0.06)], data[on_handle][:count]))
        return float(
            curvature(problem_of(skin, seen[None], pose[None], prior_std=0.3, pose_atol=1e-3), pose[None])
            .covariance[0, 6, 6]
            .sqrt()
        )

    assert std(1) > 0.5 * std(0)
    assert std(10) < 0.2 * std(0)


ROBOT = """<robot name="arm"><link name="base"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual></link>
{links}</robot>"""
LINK = """<link name="{name}"><visual><origin xyz="0 0 0.15"/><geometry>{solid}</geometry></visual></link>
<joint name="{joint}" type="{kind}"><parent link="{parent}"/><child link="{name}"/><origin xyz="0 0 {height}"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>"""
BOX, CYLINDER = '<box size="0.06 0.09 0.3"/>', '<cylinder radius="0.05" length="0.3"/>'


@pytest.mark.parametrize(("solid", "kind", "seen", "is_open"), [
    (BOX, "revolute", True, False), (CYLINDER, "revolute", True, True), (CYLINDER, "continuous", True, True),
    (BOX, "continuous", False, True),
])  # fmt: skip
def test_joints_that_no_data_determine_are_named_whatever_the_status(tmp_path, solid, kind, seen, is_open):
    """The turn of a cylinder about its own axis, which has the facets of a mesh, and that of a missing link."""
    links = [
        ("upper", BOX, "lift", "revolute", "base", 0.05, "0 1 0"),
        ("tool", solid, "roll", kind, "upper", 0.3, "0 0 1"),
    ]
    names = "name", "solid", "joint", "kind", "parent", "height", "axis"
    rows = [LINK.format(**dict(zip(names, link, strict=True))) for link in links]
    (tmp_path / "arm.urdf").write_text(ROBOT.format(links="".join(rows)))
    arm = tr.ArticulatedShape.from_urdf(tmp_path / "arm.urdf", free_base=False)
    pose = arm.pose_from_dict({"lift": 0.6, "roll": 0.4})
    skin = tr.sample_skin(arm, 900)
    kept = torch.ones(len(skin), dtype=torch.bool) if seen else skin.weights.argmax(-1) < 2
    data = skin(pose)[kept] + 0.001 * torch.randn(int(kept.sum()), 3, generator=torch.Generator().manual_seed(0))
    found = tr.align(arm, data, pose, config=tr.AlignConfig(search="never"))
    assert ("not determined by the data: roll (+- " in found.doubt) is is_open
    assert "lift (" not in found.doubt
    # Without data the standard deviation is a radian, as the limits are wider than that of it.
    assert found.named_std["roll"] == pytest.approx(1.0, rel=0.1) if is_open else found.named_std["roll"] < 0.1
    assert found.named_std["lift"] < 0.05
    confidence = dict(zip(arm.dof_names, found.dof_confidence.tolist(), strict=True))
    assert (confidence["roll"] < 0.2, confidence["lift"] > 0.99, confidence["base_x"]) == (is_open, True, 1.0)
    held = tr.align(arm, data, pose, locked=["roll"], config=tr.AlignConfig(search="never"))
    assert "roll" not in held.doubt
    assert held.dof_confidence[-1] > 0.99


def test_a_batch_names_deviations_as_it_names_poses_and_what_is_seen_is_determined(plain_hand, plain_hand_skin):
    pose = plain_hand.rest_pose().expand(2, -1)
    noise = 0.001 * torch.randn(2, len(plain_hand_skin), 3, generator=torch.Generator().manual_seed(0))
    found = tr.align(plain_hand, plain_hand_skin(pose) + noise, pose, config=tr.AlignConfig(search="never"))
    assert not any("determined" in doubt for doubt in found.doubt)
    assert list(found.named_std) == list(found.named_pose)
    assert found.named_std["little_dip_flexion"].shape == (2,)
    assert found.dof_confidence.shape == (2, plain_hand.num_dofs)
    assert bool((found.dof_confidence > 0.5).all())


def test_the_covariance_is_that_of_shapes_of_other_proportions(links, links_skin, measured):
    pose, _ = measured
    generator, other, clouds = torch.Generator().manual_seed(2), copy.deepcopy(links), []
    with torch.no_grad():
        for _ in range(24):
            for scales in (other.log_length_scales, other.log_radius_scales):
                scales.copy_(0.05 * torch.randn(scales.shape, generator=generator, dtype=scales.dtype))
            vertices = other.surface_mesh(pose, spacing=0.012).vertices
            clouds.append(vertices[farthest_points(vertices, 300)])
    config = tr.AlignConfig(search="never", prior_std=None)
    found = tr.align(links, torch.stack(clouds), pose.expand(24, -1), model_points=links_skin, config=config)
    off = difference(found.pose, pose.expand(24, -1))
    squares = (off * torch.linalg.solve(found.covariance, off.unsqueeze(-1)).squeeze(-1)).sum(-1)
    assert 0.4 < float(squares.mean()) / len(pose) < 1.6
    # So do the variances alone.
    told = found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert float(off.square().sum(-1).mean()) == pytest.approx(float(told.mean()), rel=0.6)


def test_doubts_name_the_limb_and_the_reason(plain_hand, plain_hand_skin):
    pose = plain_hand.rest_pose()[None]
    part = plain_hand_skin.weights.argmax(-1)
    hidden = [number for number, name in enumerate(plain_hand.part_names) if name.startswith("ring")]
    data = plain_hand_skin(pose)[:, ~torch.isin(part, torch.tensor(hidden))]
    problem = problem_of(plain_hand_skin, data, pose, origin=data.mean(1), pose_atol=1e-3)
    local = pose.clone()
    local[:, :3] -= problem.origin
    (told,) = judge(problem, local, pose.new_tensor([0.0])).doubt
    assert "hardly any data show where ring ends" in told
    assert "another pose explains nearly as much" in told
