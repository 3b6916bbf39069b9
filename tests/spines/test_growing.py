"""Spines of what grows: organs with births and ends, one tree of all of them, limbs that are not there yet."""

from itertools import pairwise

import pytest
import torch

import torchreg as tr
from experiments.made_up.plants import PlantForm, growing_plant
from tests.spines.bodies import random, shuffled, star_skeleton
from torchreg.spines.growth import growing_limbs, organ_graph, organ_tracks
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.names.tip_features import TipObservations


def tree(*splits):
    return frozenset(frozenset(split) for split in splits)


def test_tips_that_appear_hide_and_end_keep_their_names():
    lives = [range(12), range(12), [*range(5), *range(7, 12)], range(4, 12), range(7), [6]]
    places, frames, truth = torch.nn.functional.normalize(random(6, 3, seed=1), dim=-1), [], []
    for number in range(12):
        places = places + 0.02 * random(6, 3, seed=10 + number)
        there = torch.tensor([k for k, life in enumerate(lives) if number in life])
        truth.append(there[shuffled(len(there), number)])
        count, curves = len(there), places[truth[-1]][:, None] * torch.linspace(1, 0, 8).double()[:, None]
        zeros = [torch.zeros(size) for size in ((count, count), (count, count, count), (count, 3))]
        frames.append(TipObservations(curves, *zeros))
    certainties = [torch.where(organs == 5, -1.0, 1.0).double() for organs in truth]  # a bump of one frame
    tracks = organ_tracks.track_organs(frames, certainties)
    assert tracks.births.tolist() == [0, 0, 0, 0, 4]
    assert sorted(tracks.ends.tolist()) == [6, 11, 11, 11, 11]
    assert tracks.alive.sum(0).tolist() == (tracks.ends - tracks.births + 1).tolist()
    for name in range(5):
        shown = [(frame, int(tip)) for frame, tip in enumerate(tracks.labels[:, name]) if tip >= 0]
        assert len({int(truth[frame][tip]) for frame, tip in shown}) == 1
    assert torch.equal(tracks.confidence.isnan(), ~tracks.alive)
    assert float(tracks.confidence.nan_to_num(1.0).min()) > 0.5


def test_trees_of_parts_make_the_tree_of_all_by_majority():
    whole, every = tree({1, 2}, {1, 2, 3}, {4, 5}), frozenset(range(6))
    rows = [(every - {gone}, organ_graph.restricted(whole, every - {gone})) for gone in (5, 3, 0, 1)]
    assert organ_graph.common_graph(rows, 6).splits == LimbGraph(6, whole).splits
    base, grown = frozenset(range(4)), frozenset(range(5)) - {1}
    rows = [(base, tree({2, 3}))] * 3 + [(grown, tree({3, 4}))] * 2 + [(grown, tree({2, 3}))]
    assert organ_graph.common_graph(rows, 5).splits == tree({2, 3, 4}, {3, 4})


def test_limbs_between_shown_organs_are_chains_of_the_graph():
    graph = LimbGraph(5, tree({1, 2}, {1, 2, 3}))
    part, chains = organ_graph.shown_graph(graph, frozenset({0, 1, 4}))
    assert part.splits == frozenset()
    ends = [[graph.edges[limb].tolist()[:: 1 if ahead else -1] for limb, ahead in zip(c.limbs, c.forward, strict=True)]
            for c in chains]  # fmt: skip
    for limbs, tip in zip(ends, (0, 1, 4), strict=True):
        assert limbs[0][0] == tip
        assert all(before[1] == after[0] for before, after in pairwise(limbs))
    assert len({limbs[-1][1] for limbs in ends}) == 1
    between = organ_graph.limbs_between(graph, torch.tensor([[True, True, False, False, True]]))[0]
    assert sorted(limb for c in chains for limb in c.limbs) == between.nonzero()[:, 0].tolist()


def test_limbs_have_no_length_before_their_birth_and_are_interpolated_where_hidden():
    directions = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]).double()
    skeletons = [
        star_skeleton(directions[: len(lengths)] * torch.tensor(lengths).double()[:, None])
        for lengths in ([1.0, 1, 1], [2.0, 1, 1, 1], [3.0, 1, 1], [4.0, 1, 1, 3])
    ]
    labels = torch.tensor([[0, 1, 2, -1], [0, 1, 2, 3], [0, 1, 2, -1], [0, 1, 2, 3]])
    births, ends = torch.tensor([0, 0, 0, 1]), torch.tensor([3, 3, 3, 3])
    tracks = organ_tracks.OrganTracks(labels, torch.ones(4, 4), births, ends)
    limbs = growing_limbs.growing_limbs(skeletons, tracks, LimbGraph(4, frozenset()), 5)
    assert limbs.present[:, 3].tolist() == [False, True, True, True]
    assert limbs.observed[:, 3].tolist() == [False, True, False, True]
    assert not bool(limbs.curves[0, 3].any())
    torch.testing.assert_close(limbs.curves[:, 0, 0, 0], torch.tensor([1.0, 2, 3, 4]).double())
    torch.testing.assert_close(limbs.curves[1:, 3, 0, 0], torch.tensor([-1.0, -2, -3]).double())


@pytest.fixture(scope="module")
def plant():
    return growing_plant(PlantForm(num_leaves=3, num_branchlets=0, num_early=1), 6, resolution=32)


@pytest.fixture(scope="module")
def grown(plant):
    return tr.extract_spine(plant.meshes, growing=True)


def test_a_plant_keeps_the_names_of_its_organs(plant, grown):
    near = torch.cdist(grown.tips.nan_to_num(9.0), plant.tips.nan_to_num(-9.0))  # (T, names, organs)
    own, frames = near.amin(0).argmin(-1), torch.arange(6)[:, None]
    assert sorted(own.tolist()) == list(range(5))
    assert int((grown.births - plant.births[own]).abs().max()) <= 2
    assert int((grown.ends - plant.ends[own]).abs().max()) <= 2
    alive = ~grown.tips[..., 0].isnan()
    right = near.gather(2, own.expand(6, -1).unsqueeze(-1))[..., 0] < 0.1
    assert float(right[alive].double().mean()) > 0.95
    assert torch.equal(alive, (frames >= grown.births) & (frames <= grown.ends))
    assert float(grown.confidence[alive].min()) > 0.3


def test_what_is_not_there_is_not_in_trees_tables_and_files(grown, tmp_path):
    late = int(grown.births.argmax())
    assert int(grown.births[late]) > 0
    assert len(grown.skeleton(0).tips) == int((grown.births == 0).sum()) < grown.num_tips
    assert torch.equal(grown.measurements().lengths.isnan(), grown.curves[..., 0, 0].isnan())
    assert bool(grown.model(0.0).isfinite().all())
    assert float(grown.model.lengths(0.0)[late].detach()) < 1e-6
    grown.save(tmp_path / "plant.safetensors")
    again = tr.load(tmp_path / "plant.safetensors")
    assert torch.equal(again.births, grown.births)
    torch.testing.assert_close(again.curves, grown.curves, equal_nan=True)
    far = grown.moved(torch.full((3,), 1e6, dtype=torch.float64))
    torch.testing.assert_close(far.local().tips.float(), grown.tips, equal_nan=True, rtol=0, atol=1e-5)
    with pytest.raises(tr.errors.InputError, match="frame must be from 0 to 5, got 6"):
        grown.skeleton(6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (lambda spine: {"prior": spine}, "prior"),
        (lambda _: {"config": tr.SpineConfig.growing(num_tips=3)}, "num_tips"),
        (lambda _: {"config": tr.SpineConfig.paper()}, r"SpineConfig.paper\(\)"),
    ],
)
def test_fixed_numbers_of_limbs_do_not_go_with_growth(meshes, spine, options, words):
    with pytest.raises(tr.errors.InputError, match=f"growing=True cannot be used with {words}"):
        tr.extract_spine(meshes, growing=True, **options(spine))
