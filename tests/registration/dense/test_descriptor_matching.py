import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.registration.dense import descriptor_matching as module
from torchreg.registration.dense.descriptor_matching import match_descriptors
from torchreg.registration.dense.spin_images import image_similarity


@pytest.fixture
def descriptors():
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(40, 6, generator=generator, dtype=torch.float64)
    source = target[:25] + 0.2 * torch.randn(25, 6, generator=generator, dtype=torch.float64)
    return source, target


@pytest.fixture
def places():
    generator = torch.Generator().manual_seed(1)
    return torch.rand(25, 3, generator=generator), torch.rand(40, 3, generator=generator)


@pytest.mark.parametrize("similarity", ["correlation", "overlap", "l2", "distance"])
def test_candidates_are_the_most_similar_ones_best_first(descriptors, similarity):
    scores = image_similarity(*descriptors, similarity)
    matches = match_descriptors(*descriptors, num_candidates=3, similarity=similarity)
    order = scores.argsort(dim=1, descending=True)[:, :3]
    assert torch.equal(matches.index, order)
    torch.testing.assert_close(matches.score, scores.gather(1, order))
    source, target = matches.pairs()
    assert torch.equal(source, torch.arange(25).repeat_interleave(3))
    assert torch.equal(target, order.reshape(-1))


def test_mutual_matches_are_best_from_both_sides(descriptors):
    scores = image_similarity(*descriptors)
    matches = match_descriptors(*descriptors, num_candidates=2, mutual=True)
    for row in range(25):
        expected = [j for j in scores[row].topk(2).indices.tolist() if int(scores[:, j].argmax()) == row]
        found = matches.index[row]
        assert found[found >= 0].tolist() == expected
        assert found[: len(expected)].tolist() == expected
    assert 0 < int(matches.valid.sum()) < 50
    assert bool((matches.score[~matches.valid] == -math.inf).all())


def test_far_targets_are_no_candidates(descriptors, places):
    limit = 0.3
    matches = match_descriptors(
        *descriptors, num_candidates=5, source_points=places[0], target_points=places[1], max_distance=limit
    )
    near = torch.cdist(*places) <= limit
    scores = image_similarity(*descriptors).masked_fill(~near, -math.inf)
    for row in range(25):
        count = min(5, int(near[row].sum()))
        assert int(matches.valid[row].sum()) == count
        assert torch.equal(matches.index[row, :count], scores[row].topk(count).indices)


@pytest.mark.parametrize(
    ("similarity", "dissimilar"),
    [
        ("correlation", lambda s: 1 - s),
        ("l2", lambda s: -s),
        ("distance", lambda s: -s),
        ("overlap", lambda s: torch.exp(-s)),
    ],
)
def test_matches_must_stand_out_from_all_but_their_surroundings(descriptors, places, similarity, dissimilar):
    scores = image_similarity(*descriptors, similarity)
    for separation in (0.0, 0.4):
        matches = match_descriptors(
            *descriptors, similarity=similarity, max_ratio=0.7, target_points=places[1], separation=separation
        )
        for row in range(25):
            best = int(scores[row].argmax())
            apart = (places[1] - places[1][best]).norm(dim=-1) >= separation
            apart[best] = False
            second = dissimilar(scores[row][apart].max())
            assert bool(matches.valid[row, 0]) == bool(dissimilar(scores[row, best]) <= 0.7 * second)


def test_permuting_targets_renames_the_matches(descriptors):
    source, target = descriptors
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    plain, other = (match_descriptors(source, some, mutual=True) for some in (target, target[order]))
    torch.testing.assert_close(other.score, plain.score)
    assert torch.equal(torch.where(other.valid, order[other.index], -1), plain.index)


def test_chunks_change_nothing(descriptors, places, monkeypatch):
    options = {"num_candidates": 2, "mutual": True, "max_ratio": 0.9, "max_distance": 0.8}
    options |= {"source_points": places[0], "target_points": places[1]}
    whole = match_descriptors(*descriptors, **options)
    monkeypatch.setattr(module, "_CHUNK_ENTRIES", 120)
    parts = match_descriptors(*descriptors, **options)
    assert torch.equal(whole.index, parts.index)


def test_few_or_no_descriptors():
    target = torch.rand(2, 5, generator=torch.Generator().manual_seed(0))
    assert match_descriptors(target, target, num_candidates=9).index.shape == (2, 2)
    # A single target has no rival.
    assert match_descriptors(target, target[:1], max_ratio=0.5).index.tolist() == [[0], [0]]
    nobody = match_descriptors(target[:0], target)
    assert nobody.index.shape == (0, 1)
    assert nobody.pairs()[0].numel() == 0
    assert match_descriptors(target, target[:0]).index.shape == (2, 0)


def test_bad_arguments_are_named(descriptors, places):
    with pytest.raises(InputError, match="source_points must be given with max_distance"):
        match_descriptors(*descriptors, max_distance=1.0, target_points=places[1])
    with pytest.raises(InputError, match="target_points must be given with max_distance or separation"):
        match_descriptors(*descriptors, separation=1.0)
    with pytest.raises(InputError, match="one point per descriptor"):
        match_descriptors(*descriptors, source_points=places[1])
    with pytest.raises(InputError, match="num_candidates"):
        match_descriptors(*descriptors, num_candidates=0)
    with pytest.raises(InputError, match="similarity must be one of"):
        match_descriptors(*descriptors, similarity="cosine")
    for name in ("max_ratio", "max_distance"):
        with pytest.raises(InputError, match=name):
            match_descriptors(*descriptors, **{name: -1.0})
    with pytest.raises(InputTypeError, match=r"target is torch\.float32"):
        match_descriptors(descriptors[0], descriptors[1].float())
