"""``torchreg track --view``: a page that shows every frame while it is tracked."""

import pytest

import torchreg.viz.live_track as module
from torchreg.io.points import load_points

pytest.importorskip("viser", reason="the viewer needs viser")


def test_every_frame_is_shown_while_it_is_tracked(run, folder, tmp_path, monkeypatch):
    shown = []
    real = module.LiveTrack.show
    monkeypatch.setattr(
        module.LiveTrack,
        "show",
        lambda self, points, frame: shown.append((len(points), frame.frame)) or real(self, points, frame),
    )
    answer = run(
        "track", "hand", folder / "cloud0.ply", folder / "cloud1.ply", "--start", folder / "truth0.json",
        "--movie", "none", "--no-gltf", "--view", "--port", "0", "--no-browser", "-o", tmp_path / "moving",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert "http://127.0.0.1:" in answer.output
    assert shown == [(len(load_points(folder / f"cloud{k}.ply")), k) for k in range(2)]
