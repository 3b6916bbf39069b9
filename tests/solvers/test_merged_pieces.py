import pytest
import torch

from tests.geometry.draws import rand, seeded
from torchreg.solvers.rigid_groups import merge_alike

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
