"""Viewing from the command line: files of results become pages, wrong options are told."""

import pytest
import torch

from torchreg.alignment.results import PoseStarts
from torchreg.cli import view as module
from torchreg.io.points import save_points
from torchreg.shapes.hand import Hand
from torchreg.storage import save_result

pytest.importorskip("viser", reason="the viewer needs viser")


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    place = tmp_path_factory.mktemp("view")
    rest = Hand().rest_pose()
    starts = PoseStarts(torch.stack([rest, rest]), torch.zeros(2), torch.tensor(1.0))
    save_result(starts, place / "starts.safetensors")
    save_points(place / "cloud.ply", Hand().keypoints(rest))
    save_points(place / "mesh.ply", torch.eye(3), faces=torch.tensor([[0, 1, 2]]))
    return place


def test_a_result_becomes_one_file(run, result, tmp_path):
    answer = run(
        "view", result / "starts", "--shape", "hand", "--data", result / "cloud.ply", "--html", tmp_path / "a.html"
    )
    assert answer.exit_code == 0, answer.output
    assert "poses found" in answer.output
    assert (tmp_path / "a.html").stat().st_size > 100_000


def test_a_result_is_served_until_interrupted(run, result, monkeypatch):
    opened = []

    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(module.time, "sleep", interrupted)
    answer = run("view", result / "starts", "--shape", "hand", "--port", "0", "--up", "-y")
    assert answer.exit_code == 0, answer.output
    assert opened[0] in answer.output
    assert opened[0].startswith("http://127.0.0.1:")


def test_data_are_read_as_they_are(result):
    points, mesh = module._read([result / "cloud.ply", result / "mesh.ply"])
    assert points.shape == (21, 3)
    assert mesh.num_faces == 1


def test_what_does_not_fit_is_refused(error_of, result, tmp_path):
    assert "shape must be given" in error_of("view", result / "starts", "--html", tmp_path / "a.html")
    assert "--up must be one of" in error_of("view", result / "starts", "--up", "w")
    assert "must end in" in error_of("view", result / "starts", "--html", tmp_path / "a.txt")
    assert "about a --shape" in error_of("view", result / "starts", "--fixed-base")
    assert "nowhere" in error_of("view", result / "nowhere", "--shape", "hand")
