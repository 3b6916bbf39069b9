"""Scenes as recordings of rerun, read back by its own reader where it is installed."""

import sys

import numpy as np
import pytest
import torch

from torchreg.errors import InputError, MissingExtraError
from torchreg.geometry.mesh import unit_sphere
from torchreg.viz.rerun_log import scene_rrd
from torchreg.viz.scene import Cloud, Curves, Meshes, MovingMesh, Scene


def scene():
    ball = unit_sphere(1)
    moving = torch.stack((ball.vertices, ball.vertices + 1, torch.full_like(ball.vertices, torch.nan)))
    curves = torch.rand(3, 2, 4, 3)
    layers = (
        MovingMesh("shape", moving, ball.faces, torch.rand(len(ball.vertices), 3)),
        Meshes("surface", [ball] * 3),
        Cloud("all the data", [ball.vertices], (0.1, 0.2, 0.3)),
        Cloud("hidden", [ball.vertices], (0.1, 0.2, 0.3), visible=False),
        Curves("limbs", curves, torch.rand(2, 3), labels=("0",)),
    )
    return Scene("a title", layers, torch.tensor([1.0, 1.5, 2.0]), (0.0, 0.0, 1.0), {"status": "converged"})


def test_layers_are_entities_and_frames_times(tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="recordings need the extra rerun")
    shown = scene()
    chunks = chunk.RrdReader(scene_rrd(tmp_path / "a.rrd", shown)).stream().to_chunks()
    found = {}
    for item in chunks:
        table = item.to_record_batch()
        kept = [name for name in table.schema.names if name == "time" or ":" in name]  # not the clock's
        for row in table.select(kept).to_pylist():
            found.setdefault(item.entity_path, []).append(row)
    names = {"/scene/shape", "/scene/surface", "/scene/all\\ the\\ data", "/scene/limbs", "/scene", "/about"}
    assert {name for name in found if not name.startswith("/__")} == names
    assert [row["time"].total_seconds() for row in found["/scene/limbs"]] == [0, 0.5, 1]
    rows = [row for row in found["/scene/shape"] if row.get("Mesh3D:vertex_positions")]
    assert len(rows) == 2  # the shape was not found in the last frame
    np.testing.assert_allclose(rows[1]["Mesh3D:vertex_positions"], shown.layers[0].points(1), atol=1e-6)
    np.testing.assert_allclose(found["/scene/limbs"][2]["LineStrips3D:strips"], shown.layers[4].points(2), atol=1e-6)
    assert found["/about"][0]["TextDocument:text"] == ["a title\nstatus: converged"]


def test_without_rerun_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"torchreg-articulated\[rerun\]"):
        scene_rrd(tmp_path / "a.rrd", scene())
    with pytest.raises(InputError, match=r"path must end in \.rrd"):
        scene_rrd(tmp_path / "a.html", scene())
