"""Posing from the command line: handles arrive, other results are refused."""

import math

import pytest
import torch

from torchreg.alignment.results import PoseStarts
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.io.points import load_points
from torchreg.registration.register import register
from torchreg.viz.pose_editor import PoseEditor


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    place = tmp_path_factory.mktemp("results") / "out.safetensors"
    pair = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=800), step=math.radians(20)).pair(0, 1)
    found = register(pair.source, pair.target, 6, 25, start=pair.truth)
    found.save(place)
    return place, found


def _text(place, mark):
    return mark.join(str(number) for number in place.tolist())


def test_handles_come_to_their_targets(run, result, tmp_path):
    place, found = result
    ends = [int(found.points[:, 1].argmin()), int(found.points[:, 1].argmax())]
    targets = found.deformed[ends] + 0.01
    options = []
    for end, target in zip(ends, targets, strict=True):
        options += ["--handle", _text(found.points[end], ","), "--to", _text(target, " ")]
    answer = run("pose", place.with_suffix(""), *options, "-o", tmp_path / "posed.ply")
    assert answer.exit_code == 0, answer.output
    assert "miss" in answer.output
    posed = load_points(tmp_path / "posed.ply").points
    assert posed.shape == found.points.shape
    assert float((posed[ends] - targets).norm(dim=-1).max()) < 0.005


def test_what_does_not_fit_is_refused(error_of, result, tmp_path):
    place, _ = result
    one = ["--handle", "0,0,0", "--to", "0,0,0"]
    assert "equally often" in error_of("pose", place, *one, "--to", "0,0,1", "-o", tmp_path / "no.ply")
    assert "three numbers" in error_of("pose", place, "--handle", "0,0", "--to", "0,0,up", "-o", tmp_path / "no.ply")
    assert "must end in" in error_of("pose", place, *one, "-o", tmp_path / "no.obj")
    other = tmp_path / "starts.safetensors"
    PoseStarts(torch.zeros(1, 6), torch.zeros(1), torch.tensor(1.0)).save(other)
    assert "holds a PoseStarts" in error_of("pose", other, *one, "-o", tmp_path / "no.ply")


def test_without_handles_a_page_opens(run, error_of, result, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the viewer needs viser")
    place, found = result

    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchreg.cli.view.time.sleep", interrupted)
    editor = PoseEditor(found)
    editor.add_handle(0)
    editor.drag({0: editor.placed()[0] + 0.05})
    editor.save_pose(tmp_path / "start.safetensors")
    answer = run("pose", place, "--start", tmp_path / "start", "--no-browser", "--port", "0", "-o", tmp_path / "p.ply")
    assert answer.exit_code == 0, answer.output
    assert "http://127.0.0.1:" in answer.output
    assert "a pose to start from" in error_of("pose", place, "--start", place, "-o", tmp_path / "p.ply")
