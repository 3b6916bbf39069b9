"""The learnt matcher: what it finds on a kind never seen in training, symmetries, batches, gradients."""

import pytest
import torch

import torchreg as tr
from experiments.made_up.creature_kinds import HELD_OUT_KINDS
from experiments.made_up.creature_parts import Draw
from experiments.made_up.matching_pairs import matching_pairs
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.scan_tokens import ScanTokens


@pytest.fixture(scope="module")
def pair():
    return next(matching_pairs(3, {"bird": HELD_OUT_KINDS["bird"]}))


@pytest.fixture(scope="module")
def matcher():
    return tr.ScanMatcher()


def turned(scan, seed=0):
    axis = Draw(torch.Generator().manual_seed(seed)).direction()
    return scan.transformed(se3_exp(torch.cat((torch.tensor([3.0, -1.0, 7.0]), 2.0 * axis))).to(scan.points))


def mirrored(scan):
    flip = torch.tensor([-1.0, 1.0, 1.0]).to(scan.points)
    faces = None if scan.faces is None else scan.faces.flip(1)
    return tr.RangeScan(scan.points * flip, faces, scan.normals * flip)


def test_most_visible_points_of_a_kind_never_trained_on_are_found(matcher, pair):
    found = matcher.match(pair.source, pair.target)
    truth, visible = (values[found.source_index] for values in (pair.source_truth, pair.source_visible))
    places = pair.target.points[found.target_index]
    right = (places[found.probability.argmax(1)] - truth).norm(dim=-1) < 0.05 * pair.target.diagonal
    anything = (places[0] - truth).norm(dim=-1) < 0.05 * pair.target.diagonal
    assert float(right[visible].double().mean()) > 0.6
    assert float(anything[visible].double().mean()) < 0.3


def test_turns_shifts_and_size_of_either_scan_change_nothing(matcher, pair):
    # In double precision: what rounding does to neighbors on the surface is another matter.
    source, target = (scan.to(torch.float64) for scan in (pair.source, pair.target))
    alone = matcher.match(source, target)
    double = target.transformed(torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64)))
    moved = matcher.match(turned(source), turned(double, 1))
    assert torch.equal(moved.source_index, alone.source_index)
    torch.testing.assert_close(moved.probability, alone.probability, atol=2e-3, rtol=0)


def test_right_is_told_from_left(matcher, pair):
    alone, flipped = (ScanTokens.from_scan(scan) for scan in (pair.source, mirrored(pair.source)))
    same, other = matcher(alone, alone), matcher(alone, flipped)
    assert float((same - other).detach().abs().mean()) > 1e-3 * float(same.detach().abs().mean())


def test_source_and_target_are_alike(matcher, pair):
    there, back = matcher.match(pair.source, pair.target), matcher.match(pair.target, pair.source)
    torch.testing.assert_close(there.probability, back.probability.mT, atol=1e-4, rtol=0)
    torch.testing.assert_close(there.hidden, back.target_hidden, atol=1e-4, rtol=0)


def test_a_batch_gives_what_its_pairs_give_alone(matcher, pair):
    tokens = [ScanTokens.from_scan(scan) for scan in (pair.source, pair.target)]
    single = matcher(*tokens)
    double = matcher(ScanTokens.stack(tokens), ScanTokens.stack(tokens[::-1]))
    torch.testing.assert_close(double[:1], single, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(double[1:], single.mT, atol=1e-4, rtol=1e-4)


def test_probabilities_are_products_of_both_choices(matcher, pair):
    logits = matcher(*(ScanTokens.from_scan(scan) for scan in (pair.source, pair.target)))[0].detach()
    found = matcher.match(pair.source, pair.target)
    rows, columns = logits[:-1].softmax(1), logits[:, :-1].softmax(0)
    torch.testing.assert_close(found.probability, rows[:, :-1] * columns[:-1])
    torch.testing.assert_close(found.hidden, rows[:, -1])
    torch.testing.assert_close(found.target_hidden, columns[-1])


def test_gradients_reach_every_parameter(pair):
    matcher = tr.ScanMatcher(pretrained=False)
    tokens = [ScanTokens.from_scan(scan) for scan in (pair.source, pair.target)]
    matcher(*tokens).log_softmax(2)[:, :-1].mean().backward()
    assert all(
        parameter.grad is not None and bool(parameter.grad.isfinite().all()) for parameter in matcher.parameters()
    )


def test_tokens_of_a_small_scan_repeat_and_stay_finite(matcher):
    grid = torch.cartesian_prod(torch.linspace(0, 1, 7), torch.linspace(0, 1, 7))
    plane = tr.RangeScan(torch.cat((grid, torch.zeros(49, 1)), 1), viewpoint=(0.5, 0.5, 3.0))
    found = matcher.match(plane, plane)
    assert bool(found.probability.isfinite().all())
    assert bool(((found.hidden >= 0) & (found.hidden <= 1)).all())
    assert found.source_index.unique().numel() == 49


def test_distances_of_tokens_lead_along_the_surface():
    # A strip bent to a U: its ends are near in space and far along it.
    angle = torch.linspace(0, 3.1, 120)
    arc = torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    points = torch.cat([arc + torch.tensor([0.0, 0.0, z]) for z in torch.linspace(0, 0.2, 8)])
    arms = torch.cat([torch.stack((torch.full((60,), x), -torch.linspace(0, 2.5, 60), torch.full((60,), z)), 1)
                      for x in (-1.0, 1.0) for z in torch.linspace(0, 0.2, 8).tolist()])  # fmt: skip
    tokens = ScanTokens.from_scan(tr.RangeScan(torch.cat((points, arms))))
    places = tokens.at_tokens(tokens.points)[0].double() * float(tokens.scale)
    apart, geodesic = torch.cdist(places, places), tokens.geodesic[0].double() * float(tokens.scale)
    assert bool((geodesic >= apart - 1e-3).all())
    ends = [int((places - places.new_tensor([x, -1.9, 0])).norm(dim=1).argmin()) for x in (-1, 1)]
    assert float(geodesic[ends[0], ends[1]]) > 2 * float(apart[ends[0], ends[1]])


def test_neighbors_lie_within_their_radius(pair):
    tokens = ScanTokens.from_scan(pair.source)
    places = tokens.at_tokens(tokens.points)[0]
    apart = (tokens.points[0][tokens.neighbors[0]] - places[:, None]).norm(dim=-1)
    near, wide = (half.amax() for half in apart.chunk(2, 1))
    assert float(near) < 0.75 * float(wide)
    assert float(wide) < 0.5


@pytest.mark.parametrize("name", ["source", "target"])
def test_what_is_no_scan_is_refused(matcher, pair, name):
    scans = {"source": pair.source, "target": pair.target, name: pair.source.points}
    with pytest.raises(tr.errors.InputTypeError, match=f"{name} must be a RangeScan"):
        matcher.match(**scans)
