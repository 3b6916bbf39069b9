"""``torchreg train-initializer``: trains, and refuses shapes whose base is bolted down and weights of others."""

from dataclasses import replace
from pathlib import Path

import torchreg as tr
import torchreg.alignment.train_initializer as train_module


def test_weights_are_written_and_loaded(run, tmp_path, monkeypatch):
    small = replace(train_module._TRAINING, surface_points=200, validation=8)
    monkeypatch.setattr(train_module, "_TRAINING", small)
    path = tmp_path / "hand.safetensors"
    found = run("train-initializer", "hand", "-o", path, "--minutes", "0.0001", "--batch", "2")
    assert found.exit_code == 0, found.output
    assert "step 1 " in found.output
    assert tr.PoseProposer.load(path, tr.Hand()).dof_names == tuple(tr.Hand().dof_names)


def test_the_weights_of_another_shape_and_a_fixed_base_are_refused(run, folder, tmp_path):
    weights = next((Path(tr.__file__).parent / "alignment").rglob("hand_poses.safetensors"))
    for words, message in (
        (["align", "hand-left", folder / "cloud0.ply", "--initializer", weights], "another shape"),
        (["track", folder / "arm.urdf", folder / "arm.npz", "--initializer", weights], "another shape"),
        (["align", "hand", folder / "cloud0.ply", "--initializer", weights, "--side", "either"], "--side either"),
        (["train-initializer", folder / "arm.urdf", "--fixed-base"], "base that can move"),
    ):
        found = run(*words, "-o", tmp_path / "out")
        assert found.exit_code == 2
        assert message in found.output
    assert not list(tmp_path.glob("*.json"))
