"""Links between pieces: as a slow search finds them, from piece to piece, the nearest first."""

import numpy as np
import pytest
from torchreg.geometry.islands import island_links


def slowly(places, piece, count):
    """Return the links as sets, by trying all pairs of points for every piece."""
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    grown, found = [int(np.bincount(piece).argmax())], []
    while len(grown) <= piece.max():
        inside = np.isin(piece, grown)
        gap = np.where(inside[:, None] & ~inside, apart, np.inf)
        following = piece[gap.min(0).argmin()]
        members = np.flatnonzero(piece == following)
        nearest = sorted(members, key=lambda point: gap[:, point].min())[:count]
        found += [frozenset((int(point), int(gap[:, point].argmin()))) for point in nearest]
        grown.append(int(following))
    return found


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (3, 1), (3, 2), (50, 3)])
def test_links_are_those_of_a_slow_search(count, seed):
    generator = np.random.default_rng(seed)
    piece = generator.integers(0, 6, 60)
    places = generator.normal(size=(60, 3)) + 8 * generator.normal(size=(6, 3))[piece]
    links, lengths = island_links(places, piece, count)
    assert [frozenset(pair) for pair in links.tolist()] == slowly(places, piece, count)
    np.testing.assert_allclose(lengths, np.linalg.norm(np.diff(places[links], axis=1)[:, 0], axis=1))
    assert (links[:, 0] < links[:, 1]).all()


def test_a_far_piece_hangs_on_the_island_between():
    places = np.array([[0.0], [1.0], [2.0], [9.0], [5.0], [6.0]])
    links, lengths = island_links(places, np.array([0, 0, 0, 1, 2, 2]), count=1)
    assert links.tolist() == [[2, 4], [3, 5]]
    assert lengths.tolist() == [3.0, 3.0]


def test_one_piece_needs_no_links():
    links, lengths = island_links(np.zeros((4, 3)), np.zeros(4, dtype=np.int64))
    assert links.shape == (0, 2)
    assert lengths.shape == (0,)
