"""Alignment of two scans: what it follows, says and reports, what is expected, threads, frames and units."""

import math
from threading import get_ident

import pytest
import torch

import torchreg as tr
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.problem import ExpectedPlaces


def scans(pair):
    return pair.source, pair.target


def share_near(pair, points):
    return float((pair.error(points) < 0.025).float().mean())


@pytest.mark.parametrize(
    ("sequence", "first", "second", "share"),
    [(walking_figure, 0, 1, 0.9), (walking_animal, 0, 2, 0.85), (jointed_toy, 1, 4, 0.85), (walking_figure, 0, 4, 0.8)],
)
def test_steps_of_anything_are_followed_and_told(sequence, first, second, share, scanner, quick):
    pair = sequence(7, scanner=scanner).pair(first, second)
    result = align_scans(*scans(pair), quick)
    assert share_near(pair, result.points) > max(share, share_near(pair, pair.source.points))
    # Some of these were followed by another thread.
    steps = [each.step for each in result.history if (each.hypothesis, each.stage) == (result.chosen.name, "refine")]
    assert steps == list(range(12))


def test_the_result_is_what_its_parts_say(pair, aligned, quick):
    assert aligned.points.dtype == aligned.point_confidence.dtype == torch.float32
    assert aligned.points.shape == pair.source.points.shape
    images = transform_points(aligned.transforms, pair.source.points)
    moved = torch.einsum("nj,jnk->nk", aligned.weights, images)
    torch.testing.assert_close(moved, aligned.points, rtol=0, atol=1e-3 * pair.source.diagonal)
    torch.testing.assert_close(aligned.weights.sum(1), torch.ones(len(moved)))
    assert bool(torch.isin(aligned.nodes, aligned.samples).all())
    assert aligned.chosen == aligned.hypotheses[0]
    assert [each.energy for each in aligned.hypotheses] == sorted(each.energy for each in aligned.hypotheses)
    ahead = align_scans(pair.source, pair.target, quick, expected=ExpectedPlaces(aligned.points, 0.01)).chosen
    assert aligned.chosen.deviation == 0
    assert ahead.deviation < 0.1


def test_confidence_separates_visible_points_from_hidden_ones(pair, aligned):
    assert 0 <= float(aligned.point_confidence.min()) <= float(aligned.point_confidence.max()) <= 1
    visible = aligned.point_confidence[pair.visible].mean()
    assert float(visible) > float(aligned.point_confidence[~pair.visible].mean()) + 0.1


def test_steps_are_reported(pair, problem, quick):
    records = []
    result = align_scans(*scans(pair), quick, on_step=records.append)
    assert tuple(records) == result.history
    assert {record.hypothesis for record in records} == {each.name for each in result.hypotheses}
    for stage, config in (("match", quick.coarse), ("refine", quick.refine)):
        own = [record for record in records if (record.hypothesis, record.stage) == ("matches", stage)]
        assert [record.step for record in own] == list(range(config.num_steps))
        widths = torch.tensor([record.width for record in own]).double() / problem.unit.scale
        torch.testing.assert_close(widths, torch.logspace(*map(math.log10, config.sigma), config.num_steps).double())
        assert (own[0].stiffness, own[-1].stiffness) == pytest.approx(config.stiffness)
    for record in records:
        assert record.matched >= 0
        assert record.energy == pytest.approx(record.residual + record.stiffness * record.smoothness)


def test_hypotheses_are_fused_unless_two_agree(pair, quick, scanner):
    same = align_scans(pair.source, pair.source, quick)
    assert {each.name for each in same.hypotheses} == {"rest", "matches"}
    torch.testing.assert_close(same.points, pair.source.points, rtol=0, atol=5e-3 * pair.source.diagonal)
    known = align_scans(pair.source, pair.source, quick, expected=ExpectedPlaces(pair.source.points, 0.0))
    assert {each.name for each in known.hypotheses} == {"rest", "expected", "matches"}
    every = align_scans(*scans(walking_animal(7, scanner=scanner).pair(0, 6)), quick)
    assert {each.name for each in every.hypotheses} == {"rest", "matches", "fused"}


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_turns_of_the_target_are_followed(pair, turn, quick):
    motion = se3_exp(torch.tensor([0.4, 0.1, -0.2, 0.3 * turn, turn, 0.1 * turn]))
    target, truth = pair.target.transformed(motion), transform_points(motion, pair.truth)
    apart = (align_scans(pair.source, target, quick).points - truth).norm(dim=-1) / pair.source.diagonal
    assert float((apart < 0.025).float().mean()) > 0.9


def tube(seed):
    """Return a scan of a tube, whose turns about its axis nobody can see, as sampled by a seed."""
    generator = torch.Generator().manual_seed(seed)
    angle, height = torch.rand(2, 900, generator=generator) * torch.tensor([[2 * math.pi], [2.0]])
    normals = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=1)
    return tr.RangeScan(0.5 * normals + height.unsqueeze(1) * torch.tensor([0.0, 0, 1]), normals=normals)


@pytest.mark.parametrize(("angle", "scale"), [(-0.4, 1.0), (0.4, 1e-3), (0.4, 100.0)])
def test_where_scans_do_not_tell_what_is_expected_does(angle, scale, quick):
    # Turns to both sides are 20 % of the tube's length apart: only the expectation can tell which, in any frame.
    motion = se3_exp(torch.tensor([30.0, -80, 50, 1.0, 2.0, -0.5], dtype=torch.float64))
    source, target = (tube(seed).to(torch.float64) for seed in range(2))
    turned = transform_points(se3_exp(torch.tensor([0.0, 0, 0, 0, 0, angle]).double()), source.points)
    source, target = (
        tr.RangeScan(scale * scan.points, normals=scan.normals).transformed(motion) for scan in (source, target)
    )
    places = transform_points(motion, scale * turned)
    known = align_scans(source, target, quick, expected=ExpectedPlaces(places, 0.01 * source.diagonal))
    plain = align_scans(source, target, quick)
    assert float((known.points - places).norm(dim=-1).mean()) < 0.02 * source.diagonal
    assert float((plain.points - places).norm(dim=-1).mean()) > 0.03 * source.diagonal
    deviations = {each.name: each.deviation for each in known.hypotheses}
    assert deviations["expected"] < 0.1 * deviations["rest"]
    assert {each.deviation for each in plain.hypotheses} == {0.0}


def test_wrong_expectations_do_not_harm_and_those_of_another_scan_are_refused(pair, quick):
    points, size = pair.source.points, pair.source.diagonal
    astray = points + 0.1 * size * torch.randn(3, generator=torch.Generator().manual_seed(0))
    found = align_scans(*scans(pair), quick, expected=ExpectedPlaces(astray, 0.01 * size))
    assert share_near(pair, found.points) > 0.9
    for places, std, message in (
        (points[1:], 0.1, "expected.places must have shape"),
        (points.log(), 0.1, "expected.places must be finite"),
        (points, -0.1, "expected.std"),
    ):
        with pytest.raises(tr.errors.InputError, match=message):
            align_scans(*scans(pair), quick, expected=ExpectedPlaces(places, std))


def test_the_same_call_gives_the_same_bits(pair, aligned, quick):
    again = align_scans(pair.source, pair.target, quick)
    assert torch.equal(again.points, aligned.points)
    seeded = [align_scans(*scans(pair), quick, generator=torch.Generator().manual_seed(5)) for _ in range(2)]
    assert torch.equal(seeded[0].points, seeded[1].points)


def test_threads_change_neither_bits_nor_reports(scanner, quick):
    pair = walking_figure(6, scanner=scanner).pair(0, 4)
    before, runs = torch.get_num_threads(), []
    try:
        for number in (1, 4):
            torch.set_num_threads(number)
            told = []
            found = align_scans(*scans(pair), quick, on_step=lambda record, to=told: to.append((get_ident(), record)))
            assert {thread for thread, _ in told} == {get_ident()}
            assert tuple(record for _, record in told) == found.history
            runs.append(found)
    finally:
        torch.set_num_threads(before)
    for other in runs[1:]:
        assert torch.equal(runs[0].points, other.points)
        assert runs[0].hypotheses == other.hypotheses
        assert runs[0].history == other.history


def test_other_frames_and_units_give_the_same_motion(pair, quick):
    motion = se3_exp(torch.tensor([3.0, -8.0, 5.0, 1.0, 2.0, -0.5], dtype=torch.float64))
    motion[:3] = 100 * motion[:3]
    double = [scan.to(torch.float64) for scan in scans(pair)]
    moved = align_scans(*(scan.transformed(motion) for scan in double), quick)
    plain = align_scans(*double, quick)
    apart = (moved.points - transform_points(motion, plain.points)).norm(dim=-1) / (100 * pair.source.diagonal)
    assert float(apart.median()) < 1e-4
    assert moved.chosen.energy == pytest.approx(plain.chosen.energy, rel=0.05)


def test_scans_without_faces_align(pair, quick):
    source, target = (tr.RangeScan(scan.points, normals=scan.normals) for scan in scans(pair))
    assert share_near(pair, align_scans(source, target, quick).points) > 0.85


def capsule(start, end, radius, count, generator):
    """Return even points of a capsule, and normals."""
    start, end = (torch.tensor(place, dtype=torch.float64) for place in (start, end))
    length = float((end - start).norm())
    axis = (end - start) / length
    side = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    frame = torch.stack((axis, side, torch.linalg.cross(axis, side)))
    along, about = torch.rand(2, count, generator=generator, dtype=torch.float64)
    along, about = (length + 2 * radius) * along - radius, 2 * torch.pi * about
    on_axis = along.clamp(0, length)
    slant = (along - on_axis) / radius
    round_ = (1 - slant.square()).sqrt()
    normals = torch.stack((slant, round_ * about.cos(), round_ * about.sin()), dim=-1) @ frame
    return start + on_axis.unsqueeze(1) * axis + radius * normals, normals


# Torso, head, legs, left arm; right upper arm and forearm, whose hand touches the hip.
BODY = (
    ((0, 0.15, 0), (0, 0.55, 0), 0.16, 1200), ((0, 0.78, 0), (0, 0.86, 0), 0.1, 400),
    ((-0.09, 0, 0), (-0.11, -0.75, 0), 0.075, 800), ((0.09, 0, 0), (0.11, -0.75, 0), 0.075, 800),
    ((-0.2, 0.58, 0), (-0.45, 0.3, 0), 0.05, 400), ((-0.45, 0.3, 0), (-0.62, 0.05, 0), 0.045, 350),
    ((0.2, 0.58, 0), (0.46, 0.34, 0), 0.05, 400), ((0.46, 0.34, 0), (0.205, 0.12, 0), 0.045, 450),
)  # fmt: skip
UPPER_ARM, FOREARM = 6, 7


def body(raised, bent, seed):
    """Return points, normals and parts of a body with a hand on its hip, and points and normals with the arm moved."""
    generator = torch.Generator().manual_seed(seed)
    surfaces = [capsule(*part, generator) for part in BODY]
    part = torch.arange(len(BODY)).repeat_interleave(torch.tensor([count for *_, count in BODY]))
    motions = torch.eye(4, dtype=torch.float64).repeat(len(BODY), 1, 1)
    shoulder, elbow = (about(BODY[UPPER_ARM][end], angle) for end, angle in ((0, raised), (1, bent)))
    motions[UPPER_ARM], motions[FOREARM] = shoulder, shoulder @ elbow
    points, normals = (torch.cat(values) for values in zip(*surfaces, strict=True))
    moved = transform_points(motions[part], points.unsqueeze(1)).squeeze(1)
    return points, normals, part, moved, (motions[part, :3, :3] @ normals.unsqueeze(-1)).squeeze(-1)


def about(place, angle):
    """Return the turn (4, 4) about an axis that looks out of the picture."""
    turn = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, angle], dtype=torch.float64))
    place = torch.tensor(place, dtype=torch.float64)
    turn[:3, 3] = place - turn[:3, :3] @ place
    return turn


def test_a_hand_leaves_the_hip_that_it_touches():
    raised, bent = 0.2, 0.4
    points, normals, part, moved, _ = body(raised, bent, 0)
    _, _, _, there, facing = body(raised, bent, 1)
    found = align_scans(tr.RangeScan(points, normals=normals), tr.RangeScan(there, normals=facing))
    error = (found.points - moved).norm(dim=-1) / float((points.amax(0) - points.amin(0)).norm())
    assert float(error[part == FOREARM].mean()) < 0.02
    assert float(error.mean()) < 0.005


def test_tiny_flat_and_distant_scans_have_sound_results(pair, quick):
    tiny = tr.RangeScan(torch.rand(6, 3, generator=torch.Generator().manual_seed(0)))
    assert bool(align_scans(tiny, tiny, quick).points.isfinite().all())
    flat = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.0])
    plane = align_scans(tr.RangeScan(flat), tr.RangeScan(flat + 0.01), quick)
    assert float((plane.points - flat).norm(dim=-1).max()) < 0.2
    shift = torch.tensor([20.0, 0.0, 0.0])
    far = align_scans(pair.source, pair.target.shifted(shift), quick)
    assert float(((far.points - shift - pair.truth).norm(dim=-1) < 0.025 * pair.source.diagonal).float().mean()) > 0.9
