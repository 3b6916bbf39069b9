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


def test_shapes_and_scans_are_viewed_too(run, error_of, result, folder, tmp_path):
    for number, (name, told) in enumerate(
        [
            ("hand", "16 parts, 27 degrees of freedom"),
            (folder / "arm.urdf", "degrees of freedom"),
            (result / "cloud.ply", "21 points"),
            (result / "mesh.ply", "3 points, 1 triangle"),
        ]
    ):
        answer = run("view", name, "--html", tmp_path / f"{number}.html")
        assert answer.exit_code == 0, answer.output
        assert told in answer.output
    assert "did you mean 'hand'?" in error_of("view", "hands", "--html", tmp_path / "x.html")


def test_results_are_shown_with_the_shape_that_they_keep(run, result, tmp_path):
    rest = Hand().rest_pose()
    PoseStarts(rest[None], torch.zeros(1), torch.tensor(1.0), Hand()).save(tmp_path / "s.safetensors")
    answer = run("view", tmp_path / "s", "--html", tmp_path / "s.html")
    assert answer.exit_code == 0, answer.output
