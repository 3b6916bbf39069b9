"""Viewing from the command line: files of results become pages, wrong options are told."""

import pytest
import torch

import torchreg as tr
from tests.tables import each_row
from torchreg.io.points import save_points

pytest.importorskip("viser", reason="the viewer needs viser")


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    place = tmp_path_factory.mktemp("view")
    rest = tr.Hand().rest_pose()
    starts = tr.PoseStarts(torch.stack([rest, rest]), torch.zeros(2), torch.tensor(1.0))
    starts.save(place / "starts.safetensors")
    save_points(place / "cloud.ply", tr.Hand().keypoints(rest))
    save_points(place / "mesh.ply", torch.eye(3), faces=torch.tensor([[0, 1, 2]]))
    return place


def test_a_result_becomes_one_file(done, result, tmp_path):
    output = done(
        "view", result / "starts", "--shape", "hand", "--data", result / "cloud.ply", "--html", tmp_path / "a.html"
    )
    assert "poses found" in output
    assert (tmp_path / "a.html").stat().st_size > 100_000


def test_a_result_is_served_until_interrupted(done, result, monkeypatch, interrupted):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    interrupted("torchreg.cli.view.time.sleep")
    output = done("view", result / "starts", "--shape", "hand", "--port", "0", "--up", "-y")
    assert opened[0] in output
    assert opened[0].startswith("http://127.0.0.1:")


@each_row(
    (["starts", "--html", "a.html"], "shape must be given"), (["starts", "--up", "w"], "--up must be one of"),
    (["starts", "--html", "a.txt"], "must end in"), (["starts", "--fixed-base"], "about a --shape"),
    (["nowhere", "--shape", "hand"], "nowhere"),
)  # fmt: skip
def test_what_does_not_fit_is_refused(error_of, result, tmp_path, words, message):
    given = [tmp_path / word if "." in word else word for word in words[1:]]
    assert message in error_of("view", result / words[0], *given)


def test_shapes_and_scans_are_viewed_too(done, error_of, result, folder, tmp_path):
    rest = tr.Hand().rest_pose()
    tr.PoseStarts(rest[None], torch.zeros(1), torch.tensor(1.0), tr.Hand()).save(tmp_path / "s.safetensors")
    for name, shown in (
        ("hand", "16 parts, 27 degrees of freedom"), (folder / "arm.urdf", "degrees of freedom"),
        (result / "cloud.ply", "21 points"), (result / "mesh.ply", "3 points, 1 triangle"), (tmp_path / "s", "poses"),
    ):  # fmt: skip
        assert shown in done("view", name, "--html", tmp_path / "shown.html", "--force")
    assert "did you mean 'hand'?" in error_of("view", "hands", "--html", tmp_path / "x.html")
