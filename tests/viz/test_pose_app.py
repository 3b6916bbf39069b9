"""The posing application without a browser: picks, drags, buttons and files; `tests/web` uses a real mouse."""

import pytest
import torch

from torchreg.storage import load
from torchreg.viz.pose_app import PoseApp
from torchreg.viz.pose_editor import PoseEditor

pytest.importorskip("viser", reason="the viewer needs viser")


@pytest.fixture
def app(registration, tmp_path):
    with PoseApp(PoseEditor(registration), output=tmp_path / "posed", port=0) as app:
        yield app


def press(app, label):
    button = next(h for h in app.server.gui._gui_input_handle_from_uuid.values() if h.label == label)
    for callback in button._impl.update_cb:
        callback(None)


def shape(app):
    return torch.cat([torch.from_numpy(node.vertices) for node in nodes(app)])


def nodes(app):
    number = 0
    while (node := app.server.scene.get_handle_by_name(f"/shape/{number}")) is not None:
        yield node
        number += 1


def pick_end(app, sign=1.0):
    points = app.editor.moved()
    vertex = int((sign * points[:, 0]).argmax())
    outside = points[vertex] + torch.tensor([5.0 * sign, 0, 0], dtype=torch.float64)
    return app.pick(outside, points[vertex] - outside)


def test_a_click_makes_a_handle_and_one_beside_does_not(app):
    assert app.pick(torch.tensor([0.0, 0, 50]), torch.tensor([0.0, 0, 1])) is None
    assert pick_end(app) == 0
    assert app.selected == 0
    gizmo = app.server.scene.get_handle_by_name("/handles/0")
    assert gizmo.position == pytest.approx(app.editor.placed()[0].tolist())


def test_the_shape_follows_a_drag_and_undo_brings_it_back(app):
    pick_end(app)
    pick_end(app, -1.0)
    before, state = shape(app), app.editor.state
    target = app.editor.placed()[1] + torch.tensor([0.2, -0.4, 0.3])
    for share in torch.linspace(0, 1, 200):
        app.drag(1, torch.lerp(app.editor.state.targets[1], target, share))
    app.release(1, target)
    assert len(app.worker.seconds) < 200  # the mouse does not wait
    assert float((app.editor.placed()[1] - target).norm()) < 0.01 * app.editor.diagonal
    assert not torch.equal(shape(app), before)
    follows = app.server.scene.get_handle_by_name("/handles/0").position
    assert follows == pytest.approx(app.editor.placed()[0].tolist(), abs=1e-5)
    press(app, "Undo")
    assert torch.equal(shape(app), before)
    assert torch.equal(app.editor.state.transforms, state.transforms)
    press(app, "Redo")
    assert float((app.editor.placed()[1] - target).norm()) < 0.01 * app.editor.diagonal
    press(app, "Reset")
    assert app.selected == -1
    assert app.server.scene.get_handle_by_name("/handles/0") is None
    assert torch.equal(shape(app), before)


def test_handles_are_pinned_and_removed(app):
    pick_end(app)
    pick_end(app, -1.0)
    app._pin(True)
    assert app.editor.state.pinned == (False, True)
    app._select(0)
    assert not app._pinned.value
    press(app, "Remove")
    assert app.editor.state.pinned == (True,)
    press(app, "Remove")
    press(app, "Remove")  # nothing is left
    assert app.selected == -1


def test_files_are_written_and_none_is_overwritten(app, tmp_path):
    press(app, "Save pose")
    assert "nothing was posed yet" in app._status.content
    pick_end(app)
    app.release(0, app.editor.placed()[0] + torch.tensor([0.0, 0.3, 0.0]))
    for label in ("Save pose", "Export PLY", "Export PLY", "Export glTF"):
        press(app, label)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"posed.safetensors", "posed.ply", "posed_2.ply", "posed.glb"} <= names
    assert torch.equal(load(tmp_path / "posed.safetensors").transforms, app.editor.state.transforms)


def test_key_poses_are_played_and_the_pose_stays(app):
    press(app, "Play")
    assert "two key poses" in app._status.content
    press(app, "Add key pose")
    pick_end(app)
    app.release(0, app.editor.placed()[0] + torch.tensor([0.0, 0.3, 0.0]))
    press(app, "Add key pose")
    after = shape(app)
    app.play()
    assert torch.equal(shape(app), after)
    press(app, "Remove last")
    assert "1 key poses" in app._keys.content


def test_errors_are_told_on_the_page(app):
    pick_end(app)
    app.release(0, torch.full((3,), torch.nan))
    assert "targets" in app._status.content


def test_clouds_are_posed_too(registration, tmp_path):
    from dataclasses import replace

    editor = PoseEditor(replace(registration, faces=None))
    with PoseApp(editor, output=tmp_path / "cloud", port=0) as app:
        assert pick_end(app) == 0
        app.release(0, editor.placed()[0] + torch.tensor([0.0, 0.2, 0.0]))
        points = torch.from_numpy(app.server.scene.get_handle_by_name("/shape").points)
        torch.testing.assert_close(points, editor.moved().float())
