"""Scan registration end to end: errors, units, turns, repeatability, bad input, results on disk."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

import torchreg as tr
from experiments.made_up.moving_labels import moving_labels
from tests.geometry.draws import rand, randn, seeded
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp, transform_points

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError

ALIGN = tr.RegisterConfig().align
QUICK = tr.RegisterConfig(align=replace(ALIGN, num_samples=400), num_samples=800)
FEW = tr.RegisterConfig(align=replace(ALIGN, num_samples=150, num_nodes=15))


@pytest.fixture(scope="module")
def pair():
    return jointed_toy(2, seed=2, scanner=DepthScanner(num_points=1000), step=math.radians(20)).pair(0, 1)


@pytest.fixture(scope="module")
def known(pair):
    """Registered from the truth with errors of 0.7 % of the diagonal."""
    start = pair.truth + 0.004 * pair.source.diagonal * randn(*pair.truth.shape, dtype=torch.float32)
    return tr.register(pair.source, pair.target, 8, 30, start=start), start


def test_a_pair_is_registered_without_a_start(pair):
    records = []
    found = tr.register(pair.source, pair.target, 8, 30, QUICK, on_step=records.append)
    assert float((pair.error(found.deformed) < 0.025).float().mean()) > 0.9
    assert found.status.usable
    assert records[-len(found.history) :] == list(found.history)
    assert {record.stage for record in records} == {"initialize", "align", "refine"}
    assert all(bool(record.energies) == (record.stage != "initialize") for record in records)
    assert sum(found.history[-1].energies.values()) < sum(found.history[0].energies.values())
    assert found.seconds.shape == (4,)
    assert (found.seconds > 0).all()


def test_bones_filter_the_noise_of_the_start_and_may_start_from_known_parts(pair, known):
    found, start = known
    assert float(pair.error(found.deformed).mean()) < 0.7 * float(pair.error(start).mean())
    assert float(tr.metrics.adjusted_rand(found.parts(), moving_labels(pair))) > 0.8
    assert found.matched.float().mean() > 0.5
    found = tr.register(pair.source, pair.target, 10, 30, start=start, parts=pair.labels)
    assert float(tr.metrics.adjusted_rand(found.parts(0.01), moving_labels(pair, 0.01))) > 0.8
    assert float(pair.error(found.deformed).mean()) < 0.01


def test_the_table_below_is_left_out_of_both_scans(pair, known):
    start, parts = known[1], moving_labels(pair).clamp_max(7)
    plain = tr.register(pair.source, pair.target, 8, 30, start=start, parts=parts)
    low = float(min(pair.source.points[:, 1].min(), pair.target.points[:, 1].min()))
    steps = 1.5 * pair.source.diagonal * torch.linspace(-1, 1, 25)
    table, up = torch.cartesian_prod(steps, torch.tensor([low]), steps), torch.tensor([0.0, 1.0, 0.0]).expand(625, 3)

    def on_table(scan):
        points = torch.cat((table + scan.points.mean(0) * torch.tensor([1.0, 0.0, 1.0]), scan.points))
        return tr.RangeScan(points, normals=torch.cat((up, scan.normals)))

    scans, both = (on_table(pair.source), on_table(pair.target)), torch.cat((table, start))
    labels = torch.cat((torch.zeros(len(table), dtype=torch.int64), parts))
    with pytest.warns(tr.errors.FileWarning, match="points of (source|target) lie on the plane") as warned:
        found = tr.register(*scans, 8, 30, start=both, parts=labels)
    assert len(warned) == 2
    assert len(found.points) >= 0.98 * len(pair.source)
    errors = [float((each.deformed[-500:] - pair.truth[-500:]).norm(dim=1).mean()) for each in (plain, found)]
    assert errors[1] < 1.2 * errors[0]
    kept = tr.register(*scans, 8, 30, FEW, start=both, support="keep")
    assert len(kept.points) == len(scans[0])


def test_all_points_of_large_scans_are_moved_by_what_fits_a_few_of_them():
    ball = unit_sphere(6, dtype=torch.float64)
    arm = ball.vertices * (1 + 1.5 * (20 * (ball.vertices[:, :1] - 1)).exp()) * torch.tensor([1.0, 0.6, 0.4])
    source = tr.RangeScan(arm.float(), ball.faces)
    truth = transform_points(se3_exp(torch.tensor([0.02, -0.05, 0.03, 0.0, 0.05, 0.08])), source.points)
    found = tr.register(source, target := tr.RangeScan(truth, ball.faces), 4, 20)
    assert len(source) > 2 * 16_000
    assert found.deformed.shape == truth.shape
    assert float((found.deformed - truth).norm(dim=1).max()) < 0.02 * source.diagonal
    nearest = torch.cdist(found.deformed[::500].double(), target.points.double()).amin(1).float()
    torch.testing.assert_close(found.distances[::500], nearest, atol=1e-4, rtol=0)
    for name in ("labels", "matched", "point_confidence", "weights"):
        assert len(getattr(found, name)) == len(source)


def test_what_is_returned_fits_together(pair, known):
    found, points, size = known[0], pair.source.points, pair.source.diagonal
    assert found.transforms.shape == (found.model.num_bones, 4, 4)
    torch.testing.assert_close(found.weights.sum(-1), torch.ones(len(points)))
    assert torch.equal(found.labels, found.weights.argmax(-1))
    with torch.no_grad():
        torch.testing.assert_close(found.model(points), found.deformed, atol=1e-5 * size, rtol=0)
        torch.testing.assert_close(found.model.weights_at(points), found.weights, atol=1e-3, rtol=0)
    nearest = torch.cdist(found.deformed.double(), pair.target.points.double()).amin(-1)
    torch.testing.assert_close(found.distances.double(), nearest, atol=1e-5 * size, rtol=0)


def test_results_are_the_same_on_disk_and_when_found_again(pair, known, tmp_path):
    found, start = known
    found.save(tmp_path / "pair.safetensors")
    back, again = tr.load(tmp_path / "pair.safetensors"), tr.register(pair.source, pair.target, 8, 30, start=start)
    assert isinstance(back, tr.ScanRegistration)
    for name in ("points", "faces", "deformed", "labels", "transforms", "weights", "distances", "matched", "seconds"):
        assert torch.equal(getattr(back, name), getattr(found, name))
    assert (back.history, back.status) == (found.history, found.status)
    assert torch.equal(back.model.weights, found.model.weights)
    assert torch.equal(again.deformed, found.deformed)
    assert torch.equal(again.weights, found.weights)


SIZES = [
    (10, r"target is 1\d\.\d+ times as large as source.*target is in millimeters and source in centimeters, load "
         r"target with a scale of 0\.1 \(--scale 1 --scale 0\.1\)"),
    (0.1, r"source is .* as large as target.*source is in millimeters .*scale of 0\.1 \(--scale 0\.1 --scale 1\)"),
    (25.4, r"target is in millimeters and source in inches, load target with a scale of 0\.03937"),
    (39.37, r"target is in inches and source in metres, load target with a scale of 0\.0254"),
    (100, r"target is in centimeters and source in metres, load target with a scale of 0\.01"),
    (1000, r"target is in millimeters and source in metres, load target with a scale of 0\.001"),
    (0.001, r"source is in millimeters and target in metres, load source with a scale of 0\.001"),
]  # fmt: skip


@pytest.mark.parametrize(("factor", "message"), SIZES)
def test_scans_of_two_units_are_warned_of_with_the_likely_factor(pair, factor, message):
    other = tr.RangeScan(factor * pair.target.points, pair.target.faces)
    with pytest.raises(tr.errors.UnitsWarning, match=message):  # warnings are errors in tests
        tr.register(pair.source, other, 8, 30, FEW)
    if factor == 10:
        with pytest.raises(tr.errors.UnitsWarning, match=r"scans\[1\] is in millimeters and scans\[.\] in centimeters"):
            tr.register_sequence([pair.source, other, pair.target], 8, 30, FEW)


def test_a_crop_and_a_stray_point_are_no_other_unit(pair):
    points = pair.source.points
    far = tr.RangeScan(torch.cat([points, points.mean(0, keepdim=True) + 20 * pair.source.diagonal]))
    crop = pair.target.points[pair.target.points[:, 2] > pair.target.points[:, 2].quantile(0.6)]
    tr.register(far, tr.RangeScan(crop), 2, 10, FEW)


@pytest.mark.parametrize(("scale", "turn", "atol"), [(1e-3, 0.0, 1e-6), (1e3, 1.0, 5e-5)])
def test_units_and_turns_change_nothing_but_the_frame(pair, known, scale, turn, atol):
    start, source, target = known[1].double(), pair.source.to(torch.float64), pair.target.to(torch.float64)
    motion = se3_exp(turn * torch.tensor([1.0, 2.0, 3.0, 0.5, -1.0, 0.7], dtype=torch.float64))
    motion[:3] *= scale
    same = tr.register(source, target, 8, 30, start=start)
    start = transform_points(motion, start)
    other = tr.register(source.transformed(motion), target.transformed(motion), 8, 30, start=start)
    expected = transform_points(motion, same.deformed)
    torch.testing.assert_close(other.deformed / scale, expected / scale, atol=atol * source.diagonal, rtol=0)
    assert other.history[-1].kept == pytest.approx(same.history[-1].kept, abs=2)


@pytest.mark.parametrize(("bones", "cells"), [(1, 30), (500, 4)])
def test_one_bone_and_more_bones_than_cells_are_fine(pair, known, bones, cells):
    found = tr.register(pair.source, pair.target, bones, cells, start=known[1])
    assert 1 <= found.model.num_bones <= bones
    assert found.deformed.isfinite().all()
    if bones == 1:
        linear = found.transforms[0]
        moved = pair.source.points @ linear[:3, :3].mT + linear[:3, 3]
        torch.testing.assert_close(found.deformed, moved, atol=1e-4, rtol=1e-4)


def test_disjoint_scans_say_so(pair):
    far = torch.eye(4)
    far[0, 3] = 3 * pair.source.diagonal
    found = tr.register(pair.source, pair.target.transformed(far), 8, 30, start=pair.source.points)
    assert found.status in (tr.Status.NO_DATA, tr.Status.FEW_INLIERS)
    assert not found.status.usable
    assert found.deformed.isfinite().all()


def sheet(count, depth=0.0):
    return rand(count, 3).float() * torch.tensor([1.0, 0.7, depth])


def test_a_plane_is_degenerate_even_where_its_normals_look_the_other_way():
    flat = sheet(400)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(flat)
    with pytest.warns(tr.errors.DegenerateDataWarning):
        found = tr.register(tr.RangeScan(flat, normals=up), tr.RangeScan(flat, normals=-up), 3, 10)
    assert found.status is tr.Status.DEGENERATE
    assert not found.matched.any()


@pytest.mark.filterwarnings("ignore:the points of scan 0 lie on a plane")
def test_flat_and_tiny_scans_and_duplicates_are_sound():
    flat, shifted = tr.RangeScan(sheet(300)), tr.RangeScan(sheet(300) + 0.01)
    doubled, tiny = tr.RangeScan(torch.cat([sheet(200)] * 2)), tr.RangeScan(sheet(4, 0.5))
    for source, target, start in ((flat, shifted, None), (doubled, flat, doubled.points), (tiny, tiny, tiny.points)):
        found = tr.register(source, target, 4, 10, FEW, start=start)
        assert found.deformed.isfinite().all()
        assert found.deformed.shape == source.points.shape
    same = tr.register(flat, flat, 4, 10, QUICK, start=flat.points)
    assert float((same.deformed - flat.points).norm(dim=-1).max()) < 0.01


def block(size, middle, seed):
    """Samples of a box's surface and their normals."""
    box = trimesh.creation.box(size).apply_translation(middle)
    points, faces = trimesh.sample.sample_surface(box, 1000, seed=seed)
    return torch.from_numpy(points), torch.from_numpy(box.face_normals[faces])


def test_an_arm_that_lies_along_the_body_is_parted_from_it(bones):
    shoulder = torch.tensor([0.315, 0.85, 0.0], dtype=torch.float64)
    turned, arm = bones.turned_about(shoulder, [0.0, 0.0, 0.8]), (torch.arange(2000) >= 1000)[:, None]
    scans = []
    for seed in (0, 2):
        # A cell is wider than the gap of 0.005 between the two.
        parts = block((0.5, 1.0, 0.25), (0, 0.5, 0), seed), block((0.12, 0.85, 0.14), (0.315, 0.475, 0), seed + 1)
        points, normals = (torch.cat(both) for both in zip(*parts, strict=True))
        moved = torch.where(arm, transform_points(turned, points), points)
        after = torch.where(arm, normals @ turned[:3, :3].mT, normals)
        scans.append((tr.RangeScan(points, normals=normals), tr.RangeScan(moved, normals=after), moved))
    source, target, truth = scans[0][0], scans[1][1], scans[0][2]
    found = tr.register(source, target, start=truth)
    # Where the two face each other, a cell has points of both and follows one; all others go with their part.
    gaps = torch.cdist(source.points[:1000], source.points[1000:])
    alone = torch.cat((gaps.amin(1), gaps.amin(0))) > 2 * found.model.grid.spacing
    near = (found.deformed - truth).norm(dim=-1) < 0.025 * source.diagonal
    assert float(near[alone].double().mean()) > 0.99
    assert tr.metrics.adjusted_rand(found.parts(0.01)[alone], arm[alone, 0].long()) > 0.95
    apart = (found.model.joints().centers.detach() - shoulder).norm(dim=-1)
    assert float(apart.min()) < 0.05 * source.diagonal


def test_normals_of_unknown_sides_are_oriented(pair, known):
    normals = torch.where(torch.rand(len(pair.source), 1, generator=seeded(1)) < 0.5, -1.0, 1.0) * pair.source.normals
    source = tr.RangeScan(pair.source.points, pair.source.faces, normals)
    found = tr.register(source, pair.target, 8, 30, start=known[1])
    assert float(pair.error(found.deformed).mean()) < 1.5 * float(pair.error(known[0].deformed).mean())


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda pair: {"source": pair.source.points}, InputTypeError, "source must be a RangeScan"),
        (lambda pair: {"target": pair.target.points}, InputTypeError, "target must be a RangeScan"),
        (lambda pair: {"num_bones": 0}, InputError, "num_bones"),
        (lambda pair: {"grid_resolution": 1000}, InputError, "grid_resolution must be at most"),
        (lambda pair: {"support": "cut"}, InputError, "support must be"),
        (lambda pair: {"start": pair.truth[1:]}, InputError, "start must have shape"),
        (lambda pair: {"start": pair.truth * torch.nan}, InputError, "start must be finite"),
        (lambda pair: {"start": None, "confidence": pair.truth[:, 0]}, InputError, "confidence is that of start"),
        (lambda pair: {"confidence": -pair.truth[:, 0].abs()}, InputError, "confidence must not be negative"),
        (lambda pair: {"parts": torch.zeros(3, dtype=torch.int64)}, InputError, "parts must have shape"),
        (lambda pair: {"parts": torch.zeros(1)}, InputTypeError, "parts must be integers"),
        (lambda p: {"num_bones": 2, "parts": torch.arange(len(p.source)) % 3}, InputError, "num_bones - 1 = 1, .* 2"),
    ],
)
def test_bad_arguments_are_refused_by_name(pair, change, error, words):
    with pytest.raises(error, match=words):
        tr.register(**{"source": pair.source, "target": pair.target, "start": pair.truth, **change(pair)})
