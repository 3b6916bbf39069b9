import json

import pytest
import torch

import torchreg as tr

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments.made_up.matching_pairs import matching_pairs
from experiments.matcher import shards
from experiments.matcher.train import TrainConfig, assignment_loss, train, validate
from experiments.matcher.weights import export_weights
from torchreg.io.tensors import load_tensors


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """One small file, which stands for both kinds of pairs, and what it holds."""
    generator, stream = torch.Generator().manual_seed(0), matching_pairs(0)
    batch = shards.stacked([shards.tokens_of_pair(next(stream), generator) for _ in range(4)])
    file = tmp_path_factory.mktemp("pairs") / "pairs_0_0000.pt"
    torch.save(shards._packed(batch), file)
    return file, batch


def test_stored_pairs_come_back_and_exchanged_ones_are_the_same_problem(pairs):
    file, batch = pairs
    store, net = shards.PairStore([file]), tr.ScanMatcher(pretrained=False).eval()
    plain, swapped = (store.batch(torch.arange(4), torch.full((4,), swap)) for swap in (False, True))
    torch.testing.assert_close(plain.source.points, batch.source.points, atol=1e-3, rtol=0)
    torch.testing.assert_close(plain.target.geodesic, batch.target.geodesic, atol=5e-3, rtol=0)
    torch.testing.assert_close(plain.source_truth, batch.source_truth, atol=2e-3, rtol=0)
    assert torch.equal(plain.source.neighbors, batch.source.neighbors)
    torch.testing.assert_close(*(assignment_loss(net(one.source, one.target), one) for one in (plain, swapped)))


def test_training_lowers_the_loss_and_goes_on_where_it_ended(pairs, tmp_path):
    file, rows = pairs[0], []
    before = validate(tr.ScanMatcher(pretrained=False), shards.PairStore([file]))[-1]
    for steps in (15, 18):
        train([file], [file], tmp_path, TrainConfig(steps=steps, batch=2, processes=1))
        rows += [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()[len(rows) :]]
    assert rows[0]["loss"] < before.loss
    assert [row["step"] for row in rows] == [15, 18]
    assert rows[-1]["seconds"] >= rows[0]["seconds"]
    export_weights(tmp_path, tmp_path / "net.safetensors")
    tensors, metadata = load_tensors(tmp_path / "net.safetensors")
    assert metadata["training"]["step"] == 18
    tr.ScanMatcher(pretrained=False).load_state_dict({name: value.float() for name, value in tensors.items()})


def test_pairs_that_are_there_are_not_made_again(tmp_path):
    file = tmp_path / "pairs_7_0000.pt"
    file.write_bytes(b"kept")
    assert shards.make_shards(tmp_path, 50, 7, 1) == [file]
    assert file.read_bytes() == b"kept"
