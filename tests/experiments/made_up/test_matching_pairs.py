"""Pairs of scans of made-up creatures: their truth on the other scan, and kinds that are one tree each."""

import itertools

import pytest
import torch

from experiments.made_up.creature_kinds import HELD_OUT_KINDS, TRAINING_KINDS
from experiments.made_up.creature_parts import Draw, FlatCone
from experiments.made_up.matching_pairs import PosableBody, matching_pairs
from torchreg.datasets.figures import meshed_figure
from torchreg.datasets.solids import RoundCone


@pytest.fixture(scope="module")
def pairs():
    return list(itertools.islice(matching_pairs(0), 8))


def test_the_truth_lies_on_the_other_scan_where_it_is_visible_and_leads_back(pairs):
    for pair in pairs:
        for truth, visible, scan in (
            (pair.source_truth, pair.source_visible, pair.target),
            (pair.target_truth, pair.target_visible, pair.source),
        ):
            apart = torch.cdist(truth[visible], scan.points).amin(1) / scan.diagonal
            assert float(apart.max()) <= 0.03
            assert float(apart.median()) < 0.012
        assert float(pair.source_visible.double().mean()) >= 0.25
        nearest = torch.cdist(pair.source_truth[pair.source_visible], pair.target.points).argmin(1)
        back = (pair.target_truth[nearest] - pair.source.points[pair.source_visible]).norm(dim=-1)
        assert float(back.median()) < 0.02 * pair.source.diagonal


def test_a_seed_gives_the_same_stream_and_another_one_another(pairs):
    again, other = next(matching_pairs(0)), next(matching_pairs(1))
    assert torch.equal(again.source.points, pairs[0].source.points)
    assert len(other.source) != len(pairs[0].source) or not torch.equal(other.source.points, pairs[0].source.points)


@pytest.mark.parametrize("name", [*TRAINING_KINDS, *HELD_OUT_KINDS])
def test_every_kind_is_one_tree_of_parts_and_differs_at_every_draw(name):
    draw = Draw(torch.Generator().manual_seed(0))
    creatures = [{**TRAINING_KINDS, **HELD_OUT_KINDS}[name][0](draw) for _ in range(3)]
    for creature in creatures:
        names = [part.name for part in creature.parts]
        assert creature.parts[0].parent is None
        assert all(part.parent in names[:index] for index, part in enumerate(creature.parts) if index)
        assert len(creature.limits) == len(creature.parts) > 2
        assert all(0 < limit < 2.2 for limit in creature.limits)
    assert creatures[0].parts != creatures[1].parts
    assert (name in TRAINING_KINDS) != (name in HELD_OUT_KINDS)


def test_bodies_of_a_user_are_drawn_too():
    creature = TRAINING_KINDS["snake"][0](Draw(torch.Generator().manual_seed(1)))
    figure = meshed_figure(creature.parts, spacing=0.05, blend=0.01, softness=0.02)
    body = PosableBody(figure, torch.tensor(creature.limits, dtype=torch.float64))
    kinds = {pair.kind for pair in itertools.islice(matching_pairs(2, bodies={"mine": body}, body_share=1.0), 2)}
    assert kinds == {"mine"}


def test_a_flat_cone_is_flat_and_its_distances_are_bounds():
    flat = FlatCone(RoundCone((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.2, 0.2), (0.0, 0.0, 1.0), 0.5)
    surface = torch.tensor([[0.5, 0.2, 0.0], [0.5, 0.0, 0.1], [1.2, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(flat.distance(surface), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    around = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 0.5
    steps = around + 1e-4 * torch.nn.functional.normalize(around.flip(0) - 0.3, dim=1)
    assert bool(((flat.distance(steps) - flat.distance(around)).abs() <= 1.0001e-4).all())
