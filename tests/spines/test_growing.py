"""Spines of what grows: organs with births and ends, one tree of all of them, limbs that are not there yet."""

from itertools import pairwise

import pytest
import torch

from experiments.made_up.plants import PlantForm, growing_plant
from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.extract_spine import SpineConfig, extract_spine
from torchreg.spines.growth.growing_limbs import growing_limbs
from torchreg.spines.growth.organ_graph import common_graph, limbs_between, restricted, shown_graph
from torchreg.spines.growth.organ_tracks import OrganTracks, track_organs
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.names.tip_features import TipObservations
from torchreg.storage import load


def tree(*splits):
    return frozenset(frozenset(split) for split in splits)


def observed(tips):
    """Return the observations of straight limbs of length 1 that end in tips (M, 3)."""
    share = torch.linspace(0, 1, 8, dtype=torch.float64)[:, None]
    curves = tips[:, None] * (1 - share)
    count = len(tips)
    return TipObservations(curves, torch.zeros(count, count), torch.zeros(count, count, count), torch.zeros(count, 3))


def drifting(num_frames, lives):
    """Return frames of tips that drift, each there in some frames, in shuffled order, and the true organ of each."""
    generator = torch.Generator().manual_seed(1)
    start = torch.nn.functional.normalize(torch.randn(len(lives), 3, generator=generator, dtype=torch.float64), dim=-1)
    frames, truth = [], []
    for number in range(num_frames):
        start = start + 0.02 * torch.randn(start.shape, generator=generator, dtype=torch.float64)
        there = torch.tensor([k for k, life in enumerate(lives) if number in life])
        there = there[torch.randperm(len(there), generator=generator)]
        frames.append(observed(start[there]))
        truth.append(there)
    return frames, truth


def test_tips_that_appear_hide_and_end_keep_their_names():
    lives = [range(12), range(12), [*range(5), *range(7, 12)], range(4, 12), range(7), [6]]
    frames, truth = drifting(12, lives)
    certainties = [torch.where(organs == 5, -1.0, 1.0).double() for organs in truth]  # a bump of one frame
    tracks = track_organs(frames, certainties)
    assert tracks.births.tolist() == [0, 0, 0, 0, 4]
    assert sorted(tracks.ends.tolist()) == [6, 11, 11, 11, 11]
    assert tracks.alive.sum(0).tolist() == (tracks.ends - tracks.births + 1).tolist()
    for name in range(5):
        shown = [(frame, int(tip)) for frame, tip in enumerate(tracks.labels[:, name]) if tip >= 0]
        assert len({int(truth[frame][tip]) for frame, tip in shown}) == 1
    assert torch.equal(tracks.confidence.isnan(), ~tracks.alive)
    assert float(tracks.confidence.nan_to_num(1.0).min()) > 0.5


def test_trees_of_parts_make_the_tree_of_all():
    whole = tree({1, 2}, {1, 2, 3}, {4, 5})
    every = frozenset(range(6))
    shown = [every - {gone} for gone in (5, 3, 0, 1)]
    graph = common_graph([(part, restricted(whole, part)) for part in shown], 6)
    assert graph.splits == LimbGraph(6, whole).splits


def test_the_majority_of_trees_decides_where_an_organ_grows():
    base, grown = frozenset(range(4)), frozenset(range(5))
    rows = [(base, tree({2, 3}))] * 3 + [(grown - {1}, tree({3, 4}))] * 2 + [(grown - {1}, tree({2, 3}))]
    graph = common_graph(rows, 5)
    assert graph.splits == tree({2, 3, 4}, {3, 4})


def test_limbs_between_shown_organs_are_chains_of_the_graph():
    graph = LimbGraph(5, tree({1, 2}, {1, 2, 3}))
    part, chains = shown_graph(graph, frozenset({0, 1, 4}))
    assert part.splits == frozenset()
    ends = [[graph.edges[limb].tolist()[:: 1 if ahead else -1] for limb, ahead in zip(c.limbs, c.forward, strict=True)]
            for c in chains]  # fmt: skip
    for limbs, tip in zip(ends, (0, 1, 4), strict=True):
        assert limbs[0][0] == tip
        assert all(before[1] == after[0] for before, after in pairwise(limbs))
    assert len({limbs[-1][1] for limbs in ends}) == 1
    alive = torch.tensor([[True, True, False, False, True]])
    assert sorted(limb for c in chains for limb in c.limbs) == limbs_between(graph, alive)[0].nonzero()[:, 0].tolist()


def star(lengths):
    """Return a skeleton of straight limbs of such lengths from the origin along x, y, z and -x."""
    directions = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]).double()
    rows = directions[: len(lengths)] * torch.tensor(lengths).double()[:, None]
    nodes = torch.cat((rows, torch.zeros(1, 3).double()))
    edges = torch.tensor([[k, len(lengths)] for k in range(len(lengths))])
    return Skeleton(nodes, edges, torch.full((len(nodes),), 0.1).double())


def test_limbs_have_no_length_before_their_birth_and_are_interpolated_where_hidden():
    skeletons = [star([1.0, 1, 1]), star([2.0, 1, 1, 1]), star([3.0, 1, 1]), star([4.0, 1, 1, 3])]
    labels = torch.tensor([[0, 1, 2, -1], [0, 1, 2, 3], [0, 1, 2, -1], [0, 1, 2, 3]])
    tracks = OrganTracks(labels, torch.ones(4, 4), torch.tensor([0, 0, 0, 1]), torch.tensor([3, 3, 3, 3]))
    limbs = growing_limbs(skeletons, tracks, LimbGraph(4, frozenset()), 5)
    assert limbs.present[:, 3].tolist() == [False, True, True, True]
    assert limbs.observed[:, 3].tolist() == [False, True, False, True]
    assert not bool(limbs.curves[0, 3].any())
    torch.testing.assert_close(limbs.curves[:, 0, 0, 0], torch.tensor([1.0, 2, 3, 4]).double())
    torch.testing.assert_close(limbs.curves[1:, 3, 0, 0], torch.tensor([-1.0, -2, -3]).double())


@pytest.fixture(scope="module")
def plant():
    return growing_plant(PlantForm(num_leaves=3, num_branchlets=0, num_early=1), 6, resolution=32)


@pytest.fixture(scope="module")
def spine(plant):
    return extract_spine(plant.meshes, growing=True)


def test_a_plant_keeps_the_names_of_its_organs(plant, spine):
    near = torch.cdist(spine.tips.nan_to_num(9.0), plant.tips.nan_to_num(-9.0))  # (T, names, organs)
    own = near.amin(0).argmin(-1)
    assert sorted(own.tolist()) == list(range(5))
    assert int((spine.births - plant.births[own]).abs().max()) <= 2
    assert int((spine.ends - plant.ends[own]).abs().max()) <= 2
    alive = ~spine.tips[..., 0].isnan()
    right = near.gather(2, own.expand(6, -1).unsqueeze(-1))[..., 0] < 0.1
    assert float(right[alive].double().mean()) > 0.95
    assert torch.equal(alive, (torch.arange(6)[:, None] >= spine.births) & (torch.arange(6)[:, None] <= spine.ends))
    assert float(spine.confidence[alive].min()) > 0.3


def test_what_is_not_there_is_not_in_trees_tables_and_files(spine, tmp_path):
    late = int(spine.births.argmax())
    assert int(spine.births[late]) > 0
    assert len(spine.skeleton(0).tips) == int((spine.births == 0).sum()) < spine.num_tips
    lengths = spine.measurements().lengths
    assert torch.equal(lengths.isnan(), spine.curves[..., 0, 0].isnan())
    assert bool(spine.model(0.0).isfinite().all())
    assert float(spine.model.lengths(0.0)[late].detach()) < 1e-6
    spine.save(tmp_path / "plant.safetensors")
    again = load(tmp_path / "plant.safetensors")
    assert torch.equal(again.births, spine.births)
    torch.testing.assert_close(again.curves, spine.curves, equal_nan=True)
    moved = spine.moved(torch.full((3,), 1e6, dtype=torch.float64))
    torch.testing.assert_close(moved.local().tips.float(), spine.tips, equal_nan=True, rtol=0, atol=1e-5)


def test_numbers_of_limbs_do_not_go_with_growth(plant, spine):
    for options, name in (
        ({"prior": spine}, "prior"),
        ({"config": SpineConfig.growing(num_tips=3)}, "num_tips"),
        ({"config": SpineConfig.paper()}, "SpineConfig.paper"),
    ):
        with pytest.raises(InputError, match=f"growing=True cannot be used with {name}|prior cannot be used"):
            extract_spine(plant.meshes, growing=True, **options)
    with pytest.raises(InputError, match="frame must be from 0 to 5, got 6"):
        spine.skeleton(6)
