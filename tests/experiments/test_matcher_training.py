import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments.made_up.creature_parts import Draw
from experiments.made_up.matching_pairs import matching_pairs
from experiments.matcher import shards
from experiments.matcher.rigs import body_of_rig, drawn_bodies
from experiments.matcher.train import TrainConfig, assignment_loss, train, validate
from experiments.matcher.weights import export_weights
from torchreg.io.gltf_write import save_animated_skin
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
    best = max(rows, key=lambda row: row["right"])
    assert metadata["training"] == best
    tr.ScanMatcher(pretrained=False).load_state_dict({name: value.float() for name, value in tensors.items()})


def test_pairs_that_are_there_are_not_made_again(tmp_path):
    file = tmp_path / "pairs_7_0000.pt"
    file.write_bytes(b"kept")
    assert shards.make_shards(tmp_path, 50, 7, 1) == [file]
    assert file.read_bytes() == b"kept"


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """A folder with a horse and a deer in an index, one rig of three joints each, and vertices of the frames."""
    rng, parents = np.random.default_rng(0), [1, -1, 1]
    rest = np.tile(np.eye(4), (3, 1, 1))
    rest[:, :3, :3], rest[:, :3, 3] = Rotation.random(3, random_state=rng).as_matrix(), rng.normal(size=(3, 3))
    turns = Rotation.random(24, random_state=rng).as_matrix().reshape(8, 3, 3, 3)
    motions = np.tile(np.eye(4), (8, 3, 1, 1))
    for joint in (1, 0, 2):
        local = np.tile(np.eye(4), (8, 1, 1))
        local[:, :3, :3] = turns[:, joint]
        local[:, :3, 3] = rest[joint, :3, 3] - turns[:, joint] @ rest[joint, :3, 3]
        motions[:, joint] = local if joint == 1 else motions[:, 1] @ local
    vertices, weights = rng.normal(size=(12, 3)), rng.dirichlet(np.ones(3), 12)
    folder, rows = tmp_path_factory.mktemp("rigs"), ["file,kind,torchreg"]
    for name in ("deer", "horse"):
        save_animated_skin(
            folder / f"{name}.glb",
            *(torch.from_numpy(values) for values in (vertices, np.arange(12).reshape(4, 3), weights)),
            ["tip", "root", "other"], parents, torch.from_numpy(rest), torch.from_numpy(motions @ rest),
            torch.arange(8.0),
        )  # fmt: skip
        rows.append(f"{name}.glb,{name},ok")
    (folder / "index.csv").write_text("\n".join([*rows, "broken.glb,deer,cannot be read"]) + "\n")
    moved = np.einsum("vj,fjab,vb->fva", weights, motions, np.concatenate((vertices, np.ones((12, 1))), axis=1))
    return folder, torch.from_numpy(moved[..., :3])


def test_the_clips_of_a_rig_move_it_as_a_viewer_does(rigs):
    folder, moved = rigs
    body = body_of_rig(folder / "deer.glb")
    assert [len(clip) for clip in body.clips] == [8]
    found = body.figure.vertices(body.figure.transforms(body.clips[0]))
    torch.testing.assert_close(found, moved, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("held_out", "kind"), [(False, "deer"), (True, "horse")])
def test_kinds_of_rigs_that_are_held_out_are_drawn_for_nothing_else(rigs, held_out, kind):
    drawn, draw = drawn_bodies(rigs[0], held_out=held_out), Draw(torch.Generator().manual_seed(0))
    assert {drawn(draw)[0] for _ in range(5)} == {kind}
