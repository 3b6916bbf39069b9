"""Poses in JSON and stored results that hold nothing sensible are refused with errors of torchreg."""

import pytest
import torch

import torchreg as tr
from torchreg.storage import load_pose


@pytest.mark.parametrize(
    "content", [b"[" + b"9" * 4400 + b"]", b"[1e999]", b"[" * 5000, b'{"x": 1' + b"0" * 400 + b"}"]
)
def test_poses_in_json(tmp_path, content):
    (tmp_path / "pose.json").write_bytes(content)
    with pytest.raises(tr.errors.TorchregError):
        load_pose(tmp_path / "pose.json", tr.Hand())


@pytest.mark.parametrize(("poses", "costs"), [((2, 27), (3,)), ((21, 3), (2,)), ((), (2,))])
def test_results_whose_shapes_do_not_fit_are_refused(tmp_path, poses, costs):
    tr.PoseStarts(torch.zeros(poses), torch.zeros(costs), torch.ones(())).save(tmp_path / "a.safetensors")
    with pytest.raises(tr.errors.FormatError, match=r"poses|costs"):
        tr.load(tmp_path / "a.safetensors")
