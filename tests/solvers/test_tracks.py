"""The most probable tracks against all sets of tracks, and probabilities that sum to one."""

from itertools import combinations

import pytest
import torch

from tests.geometry.draws import randn
from torchreg.solvers.tracks import TrackGraph


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
