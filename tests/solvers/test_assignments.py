"""Assignments, combinations of rows and tracks against trying them all; pieces that move alike are merged."""

from itertools import combinations, permutations, product

import pytest
import torch

from tests.geometry.draws import D, rand, randn, seeded
from torchreg.solvers.assignment import assign
from torchreg.solvers.cover import best_covers
from torchreg.solvers.rigid_groups import merge_alike
from torchreg.solvers.tracks import TrackGraph


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 5), (1, 1)])
def test_no_assignment_is_cheaper(rows, columns):
    costs = rand(rows, columns, seed=rows)
    found = assign(costs)
    best = min(sum(float(costs[r, c]) for r, c in enumerate(order)) for order in permutations(range(columns), rows))
    assert float(costs[torch.arange(rows), found].sum()) == pytest.approx(best)
    assert len(set(found.tolist())) == rows


def test_rows_stay_alone_where_columns_are_few_or_dear():
    costs = torch.tensor([[0.1, 0.9], [0.2, 0.95], [0.3, 0.99]])
    assert assign(costs).tolist().count(-1) == 1
    assert assign(costs, 0.5).tolist() == [0, -1, -1]
    assert assign(costs, torch.tensor([0.05, 2.0, 2.0])).tolist() == [-1, 0, 1]
    assert assign(torch.zeros(2, 0)).tolist() == [-1, -1]
    assert assign(torch.zeros(0, 3)).tolist() == []


def test_permuting_rows_and_columns_permutes_the_answer():
    costs, rows, columns = rand(5, 6), torch.tensor([3, 1, 4, 0, 2]), torch.tensor([5, 2, 0, 1, 4, 3])
    moved = assign(costs[rows][:, columns], 0.4)
    assert torch.equal(torch.where(moved >= 0, columns[moved], -1), assign(costs, 0.4)[rows])


def problem(seed, rows=(4, 5, 3), columns=12, batch=2):
    tables = [rand(batch, count, columns, seed=seed + k) for k, count in enumerate(rows)]
    return rand(batch, columns, seed=seed), tables, [rand(batch, count, seed=seed + 9) for count in rows]


def all_totals(uncovered, tables, costs, row):
    """Every choice with its cost, from the definition."""
    found = {}
    for choice in product(*[range(table.shape[1]) for table in tables]):
        chosen = [table[row, k] for table, k in zip(tables, choice, strict=True)]
        covered = torch.stack([uncovered[row], *chosen]).amin(0).sum()
        found[choice] = float(covered + sum(c[row, k] for c, k in zip(costs, choice, strict=True)))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_wide_beam_finds_the_best_choices_in_order(seed):
    uncovered, tables, costs = problem(seed)
    index, total = best_covers(uncovered, tables, costs, count=6, beam=60, num_exchanged=0)
    for row in range(2):
        expected = all_totals(uncovered, tables, costs, row)
        ranked = sorted(expected, key=expected.get)[:6]
        assert [tuple(choice) for choice in index[row].tolist()] == ranked
        torch.testing.assert_close(total[row], torch.tensor([expected[c] for c in ranked], dtype=D))


@pytest.mark.parametrize("seed", range(4))
def test_exchanges_mend_what_a_beam_of_one_misses(seed):
    uncovered, tables, costs = problem(seed, rows=(4, 4, 4))
    greedy = best_covers(uncovered, tables, costs, count=1, beam=1, num_exchanged=0)[1]
    index, total = best_covers(uncovered, tables, costs, count=1, beam=1, num_exchanged=1, sweeps=3)
    assert (total <= greedy).all()
    for row in range(2):
        expected = all_totals(uncovered, tables, costs, row)
        torch.testing.assert_close(float(total[row, 0]), expected[tuple(index[row, 0].tolist())])
        # No exchange of two rows is left that would help.
        best = tuple(index[row, 0].tolist())
        near = [choice for choice in expected if sum(a != b for a, b in zip(choice, best, strict=True)) <= 2]
        assert expected[best] <= min(expected[choice] for choice in near) + 1e-12


def test_two_rows_that_must_change_together_are_found():
    # Each limb alone prefers the columns of the other.
    uncovered = torch.ones(1, 4)
    first = torch.tensor([[[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]])
    second = torch.tensor([[[1.0, 1.0, 1.0, 0.0], [0.0, 1.0, 1.0, 1.0]]])
    index, total = best_covers(uncovered, [first, second], [torch.zeros(1, 2)] * 2, count=1, beam=1)
    assert float(total) == 0.0
    assert index.tolist() in ([[[0, 0]]], [[[1, 1]]])


def test_batches_equal_single_problems_and_columns_may_be_permuted():
    uncovered, tables, costs = problem(7, batch=3)
    index, total = best_covers(uncovered, tables, costs)
    order = torch.randperm(uncovered.shape[1], generator=seeded())
    for row in range(3):
        one = slice(row, row + 1)
        permuted = (uncovered[one][:, order], [t[one][..., order] for t in tables], [c[one] for c in costs])
        alone = best_covers(*permuted)
        torch.testing.assert_close(alone[1][0], total[row])
        assert alone[0][0].tolist() == index[row].tolist()


def random_graph(seed):
    """Two detections in each of three frames, all pairs of frames linked."""
    links = [(a, b) for a in range(6) for b in range(6) if a // 2 < b // 2]
    real, starts, stops = randn(3, 6, seed=seed) + torch.tensor([[0.5], [-1.0], [-1.0]])
    return TrackGraph(torch.tensor(links), 2 * randn(len(links), seed=seed + 9), real, starts, stops)


def score_of(graph, used):
    """Return the best score with such links, each other detection by itself or clutter; None if a track branches."""
    first, second = graph.links[list(used)].unbind(1)
    if len(set(first.tolist())) < len(first) or len(set(second.tolist())) < len(second):
        return None
    total = float(graph.gains[list(used)].sum())
    for k in range(len(graph.real)):
        before, after = k in second, k in first
        own = float(graph.real[k]) + (0 if before else float(graph.starts[k])) + (0 if after else float(graph.stops[k]))
        total += own if before or after else max(own, 0.0)
    return total


@pytest.mark.parametrize("seed", range(4))
def test_no_set_of_tracks_is_more_probable(seed):
    graph = random_graph(seed)
    used, real, score = graph.best_tracks()
    sets = (rows for count in range(5) for rows in combinations(range(len(graph.links)), count))
    scores = [value for rows in sets if (value := score_of(graph, rows)) is not None]
    assert score == pytest.approx(max(scores))
    assert score_of(graph, used.nonzero()[:, 0].tolist()) == pytest.approx(score)
    assert bool(real[graph.links[used].reshape(-1)].all())


def test_what_becomes_of_a_detection_sums_to_one():
    graph = random_graph(5)
    links, starts = graph.link_probabilities()
    arriving = starts + torch.zeros(6).double().index_add(0, graph.links[:, 1], links)
    assert bool((arriving < 1).all())  # the rest is clutter
    assert bool((links > 0).all())
    sure = TrackGraph(graph.links[:1], torch.tensor([30.0]).double(), graph.real, graph.starts, graph.stops)
    assert float(sure.link_probabilities()[0]) == pytest.approx(1, abs=0.01)


def test_without_links_every_detection_is_a_track_or_clutter():
    none = torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0).double()
    graph = TrackGraph(*none, torch.tensor([3.0, 1.0]).double(), *torch.full((2, 2), -1.0).double())
    used, real, score = graph.best_tracks()
    assert not len(used)
    assert real.tolist() == [True, False]
    assert score == pytest.approx(1.0)


ALL = torch.ones(4, 4, dtype=torch.bool)


def row(*places, counts=(1.0, 1.0, 1.0, 1.0)):
    """Return how far apart pieces are, in all, that were shifted along a line, and the counts of their points."""
    places, counts = torch.tensor(places, dtype=torch.float64), torch.tensor(counts, dtype=torch.float64)
    return (places - places.unsqueeze(1)).abs() * counts, counts


def groups(part):
    """Return the pieces of each part."""
    return {tuple((part == each).nonzero()[:, 0].tolist()) for each in part}


def joined(apart, counts, meet=ALL, tolerance=0.1):
    return groups(merge_alike(apart.reshape(-1, 4, 4), counts, meet, tolerance))


def test_pieces_that_moved_alike_are_one_part():
    assert joined(*row(0.0, 0.05, 1.0, 1.02)) == {(0, 1), (2, 3)}
    assert joined(*row(0.0, 0.0, 0.0, 0.0), tolerance=0.0) == {(0, 1, 2, 3)}
    assert len(joined(*row(0.0, 1.0, 2.0, 3.0))) == 4


def test_only_what_meets_is_joined_but_a_part_meets_what_its_pieces_met():
    chain = torch.ones(3).diag(1).bool()
    chain |= chain.mT.clone()
    assert joined(*row(0.0, 0.0, 0.0, 0.0), meet=chain) == {(0, 1, 2, 3)}
    assert joined(*row(0.0, 5.0, 0.0, 5.0), meet=chain) == {(0,), (1,), (2,), (3,)}


def test_what_was_joined_moves_as_its_larger_piece():
    # Each is within the tolerance of the next, but not of the one after it.
    assert joined(*row(0.0, 0.06, 0.12, 0.18, counts=(4.0, 1.0, 1.0, 1.0))) == {(0, 1), (2, 3)}
    # The large one in the middle takes both sides.
    assert joined(*row(0.0, 0.09, 0.18, 9.0, counts=(1.0, 4.0, 1.0, 1.0))) == {(0, 1, 2), (3,)}


def test_the_worst_frame_counts_and_pieces_without_points_stay_alone():
    assert joined(*row(0.0, 0.0, 0.0, 9.0, counts=(2.0, 0.0, 1.0, 1.0))) == {(0, 2), (1,), (3,)}
    still, counts = row(0.0, 0.0, 0.0, 0.0)
    for frames in ((still, row(0.0, 0.0, 3.0, 3.0)[0]), (row(0.0, 0.0, 3.0, 3.0)[0], still)):
        assert joined(torch.stack(frames), counts) == {(0, 1), (2, 3)}


@pytest.mark.parametrize("seed", range(3))
def test_numbers_of_pieces_do_not_matter(seed):
    order = torch.randperm(4, generator=seeded(seed))
    apart, counts = row(*rand(4, seed=seed).tolist(), counts=(3.0, 1.0, 2.0, 5.0))
    plain, other = (joined(apart[which][:, which], counts[which], tolerance=0.3) for which in (torch.arange(4), order))
    assert plain == {tuple(sorted(order[list(part)].tolist())) for part in other}
