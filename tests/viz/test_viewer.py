"""The viewer without a browser: nodes, controls and files; `tests/web` looks at it through a browser."""

import socket
import threading
import time

import numpy as np
import pytest
import torch

from torchreg.errors import InputError
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Cloud, Scene
from torchreg.viz.viewer import SceneViewer, description, scene_html
from torchreg.viz.viser_server import HOST

pytest.importorskip("viser", reason="the viewer needs viser")
KINDS = ("alignment", "track", "demo", "starts", "calibration", "registration", "sequence", "spine")


def scene_of(everything, name, hand):
    return result_scene(everything[name], shape=hand if name in {"track", "starts"} else None)


def wait_for(condition):
    for _ in range(400):
        if condition():
            return True
        time.sleep(0.01)
    return False


def node(viewer, name):
    return viewer.server.scene.get_handle_by_name(name)


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_result_opens_here_alone(everything, name, hand, capsys):
    scene = scene_of(everything, name, hand)
    with SceneViewer(scene, port=0) as viewer:
        assert viewer.url.startswith(f"http://{HOST}:")
        assert viewer.server.get_host() == HOST
        assert viewer.server.request_share_url() is None
        with socket.create_connection((HOST, viewer.server.get_port()), timeout=5):
            pass
        viewer.show(scene.num_frames - 1)
        assert viewer.frame == scene.num_frames - 1 or scene.num_frames == 1
        with pytest.raises(InputError, match="frame must be from 0"):
            viewer.show(scene.num_frames)
    assert capsys.readouterr().out == ""


def test_frames_and_toggles_reach_the_nodes(track, hand):
    scene = result_scene(track, shape=hand)
    with SceneViewer(scene, port=0) as viewer:
        surface = node(viewer, "/layers/0/0")
        assert not surface.visible  # not found in the first frame
        viewer.show(2)
        assert surface.visible
        np.testing.assert_allclose(surface.vertices, scene.layer("shape").points(2), atol=1e-6)
        boxes = {handle.label: handle for handle in viewer.server.gui._gui_input_handle_from_uuid.values()}
        boxes["shape"].value = False
        assert wait_for(lambda: not surface.visible)
        boxes["bones"].value = True
        assert wait_for(lambda: node(viewer, "/layers/1/lines").visible)


def test_play_and_pause(sequence):
    scene = result_scene(sequence)
    with SceneViewer(Scene(scene.title, scene.layers, torch.tensor([0.0, 0.02])), port=0) as viewer:
        viewer._timeline.play()
        assert wait_for(lambda: viewer.frame == 1)
        assert wait_for(lambda: viewer.frame == 0)  # over and over
        viewer._timeline.pause()
        time.sleep(0.05)
        shown = viewer.frame
        time.sleep(0.7)
        assert viewer.frame == shown


def test_closing_ends_a_timeline_that_a_page_pauses_meanwhile(sequence):
    scene = result_scene(sequence)
    viewer = SceneViewer(Scene(scene.title, scene.layers, torch.tensor([0.0, 0.02])), port=0)
    timeline, shown, go_on = viewer._timeline, threading.Event(), threading.Event()

    def show_slowly(_):
        shown.set()
        go_on.wait(5)

    timeline._show = show_slowly
    timeline.play()
    assert shown.wait(5)
    closing = threading.Thread(target=viewer.close, daemon=True)
    closing.start()
    assert timeline._stopped.wait(5)
    time.sleep(0.01)
    timeline.pause()
    go_on.set()
    closing.join(5)
    assert not closing.is_alive()


def test_one_file_holds_it_all(spine, tmp_path):
    scene = result_scene(spine)
    path = scene_html(tmp_path / "spine.html", scene)
    content = path.read_text(encoding="utf-8")
    assert "__VISER_EMBED_DATA__" in content
    still = scene_html(tmp_path / "still.html", Scene("still", scene.layers[:1]))
    assert still.stat().st_size < path.stat().st_size
    with pytest.raises(InputError, match=r"end in \.html"):
        scene_html(tmp_path / "spine.htm", scene)
    with pytest.raises(FileNotFoundError):
        scene_html(tmp_path / "nowhere" / "spine.html", scene)


def test_pages_tell_what_they_show(tmp_path):
    cloud = Cloud("points <b>", [torch.eye(3)], (0.0, 0.0, 1.0))
    scene = Scene("a *title*", (cloud,), facts={"status": "converged"})
    told = description(scene)
    assert told.startswith("### a  title ")
    assert "status: converged" in told
    assert '<span style="color:#0000ff">&#9632;</span> points  b' in told
    page = scene_html(tmp_path / "a.html", scene).read_text(encoding="utf-8")
    assert "<title>a *title*</title>" in page
    assert "status: converged" in page
    assert "points &lt;b&gt;" in page
