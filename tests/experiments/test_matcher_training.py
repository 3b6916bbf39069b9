import json

import pytest
import torch

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments.made_up.matching_pairs import matching_pairs
from experiments.matcher.shards import PairStore, make_shards, stacked, tokens_of_pair
from experiments.matcher.train import TrainConfig, assignment_loss, train, validate
from experiments.matcher.weights import export_weights
from torchreg.io.tensors import load_tensors
from torchreg.registration.dense.scan_matcher import ScanMatcher


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    # One small file stands for both kinds of pairs.
    from experiments.matcher import shards

    folder = tmp_path_factory.mktemp("pairs")
    generator = torch.Generator().manual_seed(0)
    stream = matching_pairs(0)
    batch = stacked([tokens_of_pair(next(stream), generator) for _ in range(4)])
    file = folder / "pairs_0_0000.pt"
    torch.save(shards._packed(batch), file)
    return [file], batch


def test_stored_pairs_come_back(files):
    (file,), batch = files
    back = PairStore([file]).batch(torch.arange(4))
    torch.testing.assert_close(back.source.points, batch.source.points, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.target.geodesic, batch.target.geodesic, atol=5e-3, rtol=0)
    torch.testing.assert_close(back.source_truth, batch.source_truth, atol=2e-3, rtol=0)
    assert torch.equal(back.source.neighbors, batch.source.neighbors)


def test_exchanged_pairs_are_the_same_problem(files):
    (file,), _ = files
    store, net = PairStore([file]), ScanMatcher(pretrained=False).eval()
    plain, swapped = (store.batch(torch.arange(4), torch.full((4,), swap)) for swap in (False, True))
    losses = [assignment_loss(net(batch.source, batch.target), batch) for batch in (plain, swapped)]
    torch.testing.assert_close(*losses)


def test_training_lowers_the_loss_and_goes_on_where_it_ended(files, tmp_path):
    (file,), _ = files
    config = TrainConfig(steps=15, batch=2, processes=1)
    before = validate(ScanMatcher(pretrained=False), PairStore([file]))[-1]
    train([file], [file], tmp_path, config)
    rows = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert rows[-1]["loss"] < before.loss
    train([file], [file], tmp_path, TrainConfig(steps=18, batch=2, processes=1))
    rows += [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()[len(rows) :]]
    assert [row["step"] for row in rows] == [15, 18]
    assert rows[-1]["seconds"] >= rows[0]["seconds"]
    export_weights(tmp_path, tmp_path / "net.safetensors")
    tensors, metadata = load_tensors(tmp_path / "net.safetensors")
    assert metadata["training"]["step"] == rows[-1]["step"]
    ScanMatcher(pretrained=False).load_state_dict({name: value.float() for name, value in tensors.items()})


def test_pairs_that_are_there_are_not_made_again(tmp_path):
    file = tmp_path / "pairs_7_0000.pt"
    file.write_bytes(b"kept")
    assert make_shards(tmp_path, 50, 7, 1) == [file]
    assert file.read_bytes() == b"kept"
