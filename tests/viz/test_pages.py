"""Pages without a browser: nodes, controls, files, recordings, and who gets in; `tests/web` looks through a browser."""

import builtins
import socket
import sys
import threading
import time

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser")

import msgspec
import viser
from websockets.asyncio import server as websocket_server
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import torchreg as tr
from tests.tables import each
from torchreg.viz import live_track, rerun_log, viewer
from torchreg.viz import scene as sc
from torchreg.viz.result_scenes import result_scene

Cloud, Curves, Meshes, MovingMesh, Scene = sc.Cloud, sc.Curves, sc.Meshes, sc.MovingMesh, sc.Scene
InputError, MissingExtraError, SceneViewer = tr.errors.InputError, tr.errors.MissingExtraError, viewer.SceneViewer
HOST, SOON = "127.0.0.1", torch.tensor([0.0, 0.02])
UPGRADE = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13", "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}  # fmt: skip


@pytest.fixture(scope="module")
def ball(tools):
    return tools.ball(1)


def wait_for(condition):
    for _ in range(400):
        if condition():
            return True
        time.sleep(0.01)
    return False


def node(page, name):
    return page.server.scene.get_handle_by_name(name)


@each("alignment", "track", "demo", "starts", "calibration", "registration", "sequence", "spine")
def test_every_kind_of_result_opens_here_alone(request, hand, capsys, name):
    scene = result_scene(request.getfixturevalue(name), shape=hand if name in {"track", "starts"} else None)
    with SceneViewer(scene, port=0) as page:
        assert page.url.startswith(f"http://{HOST}:")
        assert page.server.get_host() == HOST
        assert page.server.request_share_url() is None
        with socket.create_connection((HOST, page.server.get_port()), timeout=5):
            pass
        eye = page.server.initial_camera
        for shown, expected in zip((eye.position, eye.look_at, eye.up), scene.camera(), strict=True):
            assert shown == pytest.approx(expected.tolist())
        page.show(scene.num_frames - 1)
        assert page.frame == scene.num_frames - 1 or scene.num_frames == 1
        with pytest.raises(InputError, match="frame must be from 0"):
            page.show(scene.num_frames)
    assert capsys.readouterr().out == ""


def test_every_layer_goes_from_frame_to_frame_and_toggles_reach_it(tools, ball):
    moving = torch.stack([torch.full_like(ball.vertices, torch.nan), ball.vertices])
    curves = torch.stack([torch.zeros(2, 3, 3), torch.arange(18.0).reshape(2, 3, 3)])
    clouds = [ball.vertices[:0], ball.vertices]
    painted = MovingMesh("painted", ball.vertices, ball.faces, (ball.vertices + 1) / 2)
    layers = (
        MovingMesh("plain", moving, ball.faces, opacity=0.5), painted, Meshes("meshes", [tools.ball(0), ball]),
        Cloud("cloud", clouds, [cloud.abs() for cloud in clouds]),
        Curves("curves", curves, torch.eye(3)[:2], labels=("tip",)),
        Cloud("hidden", [ball.vertices], (1.0, 0.0, 0.0), visible=False),
    )  # fmt: skip
    names = ("0/0", "1/0", "2/0", "2/1", "3", "4/lines", "5")
    with SceneViewer(Scene("all", layers), port=0) as page:

        def visible():
            return [node(page, f"/layers/{name}").visible for name in names]

        assert visible() == [False, True, True, False, False, True, False]
        page.show(1)
        assert visible() == [True, True, False, True, True, True, False]
        np.testing.assert_array_equal(node(page, "/layers/0/0").vertices, ball.vertices)
        np.testing.assert_array_equal(node(page, "/layers/3").points, ball.vertices)
        pieces = torch.stack([curves[1, limb, [step, step + 1]] for limb in range(2) for step in range(2)])
        np.testing.assert_array_equal(node(page, "/layers/4/lines").points, pieces)
        np.testing.assert_array_equal(node(page, "/layers/4/label_0").position, curves[1, 0, 0])
        # Patches of paint make up the surface.
        patches = [node(page, f"/layers/1/{number}") for number in range(len(painted.patches()))]
        assert sum(len(patch.faces) for patch in patches) == ball.num_faces
        boxes = {handle.label: handle for handle in page.server.gui._gui_input_handle_from_uuid.values()}
        boxes["plain"].value, boxes["hidden"].value = False, True
        assert wait_for(lambda: not node(page, "/layers/0/0").visible)
        assert wait_for(lambda: node(page, "/layers/5").visible)


def test_play_and_pause(sequence):
    with SceneViewer(Scene("play", result_scene(sequence).layers, SOON), port=0) as page:
        page._timeline.play()
        assert wait_for(lambda: page.frame == 1)
        assert wait_for(lambda: page.frame == 0)  # over and over
        page._timeline.pause()
        time.sleep(0.05)
        shown = page.frame
        time.sleep(0.7)
        assert page.frame == shown


def test_closing_ends_a_timeline_that_a_page_pauses_meanwhile(sequence):
    page = SceneViewer(Scene("play", result_scene(sequence).layers, SOON), port=0)
    timeline, shown, go_on = page._timeline, threading.Event(), threading.Event()

    def show_slowly(_):
        shown.set()
        go_on.wait(5)

    timeline._show = show_slowly
    timeline.play()
    assert shown.wait(5)
    closing = threading.Thread(target=page.close, daemon=True)
    closing.start()
    assert timeline._stopped.wait(5)
    time.sleep(0.01)
    timeline.pause()
    go_on.set()
    closing.join(5)
    assert not closing.is_alive()


def test_one_file_holds_it_all_and_says_what_it_shows(spine, tmp_path):
    scene = result_scene(spine)
    path = viewer.scene_html(tmp_path / "spine.html", scene)
    assert "__VISER_EMBED_DATA__" in path.read_text(encoding="utf-8")
    still = viewer.scene_html(tmp_path / "still.html", Scene("still", scene.layers[:1]))
    assert still.stat().st_size < path.stat().st_size
    with pytest.raises(InputError, match=r"end in \.html"):
        viewer.scene_html(tmp_path / "spine.htm", scene)
    with pytest.raises(FileNotFoundError):
        viewer.scene_html(tmp_path / "nowhere" / "spine.html", scene)
    cloud = Cloud("points <b>", [torch.eye(3)], (0.0, 0.0, 1.0))
    scene = Scene("a *title*", (cloud,), facts={"status": "converged"})
    text = viewer.description(scene)
    assert text.startswith("### a  title ")
    assert "status: converged" in text
    assert '<span style="color:#0000ff">&#9632;</span> points  b' in text
    page = viewer.scene_html(tmp_path / "a.html", scene).read_text(encoding="utf-8")
    for words in ("<title>a *title*</title>", "status: converged", "points &lt;b&gt;"):
        assert words in page


def test_frames_of_a_running_tracker_are_shown_as_they_come(hand, coarse, alignment, track, plain_hand_skin):
    found, lost = tr.Status.CONVERGED, tr.Status.LOST
    data = alignment.registered.clone()
    data[0] = torch.nan

    def frame_of(number, pose, status, acquired, **changes):
        known = {**vars(alignment), "pose": pose, "status": status, "covariance": torch.eye(27), **changes}
        more = {"acquired": acquired, "frame": number, "time": 0.05 * number, "inlier_ratio": 0.5, "residual": 0.001}
        return tr.FrameResult(**known, **more)

    with live_track.LiveTrack(coarse, port=0) as page:
        page.show(torch.zeros(0, 3), frame_of(0, track.poses[0], lost, "lost", inliers=torch.zeros(0) > 0))
        assert node(page, "/data") is None
        page.show(data, frame_of(1, track.poses[0], lost, "lost"))
        assert node(page, "/shape") is None
        assert len(node(page, "/data").points) == len(data) - 1
        page.show(data, frame_of(2, track.poses[1], found, "found"))
        shape = node(page, "/shape")
        np.testing.assert_allclose(shape.vertices, coarse(track.poses[1]), atol=1e-6)
        fresh = tuple(shape.color)
        assert "found" in page._label.content
        page.show(data, frame_of(3, track.poses[2], lost, "held"))
        assert tuple(shape.color) != fresh
        assert "lost" in page._label.content
        page.show(data, frame_of(4, track.poses[0], lost, "lost"))
        assert not shape.visible
    with pytest.raises(InputError, match="skin must have faces"):
        live_track.LiveTrack(plain_hand_skin, port=0)


def test_recordings_hold_layers_as_entities_and_frames_as_times(ball, tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="recordings need the extra rerun")
    moving = torch.stack((ball.vertices, ball.vertices + 1, torch.full_like(ball.vertices, torch.nan)))
    layers = (
        MovingMesh("shape", moving, ball.faces, torch.rand(len(ball.vertices), 3)), Meshes("surface", [ball] * 3),
        Cloud("all the data", [ball.vertices], (0.1, 0.2, 0.3)),
        Cloud("hidden", [ball.vertices], (0.1, 0.2, 0.3), visible=False),
        Curves("limbs", torch.rand(3, 2, 4, 3), torch.rand(2, 3), labels=("0",)),
    )  # fmt: skip
    scene = Scene("a title", layers, torch.tensor([1.0, 1.5, 2.0]), (0.0, 0.0, 1.0), {"status": "converged"})
    found = {}
    for item in chunk.RrdReader(rerun_log.scene_rrd(tmp_path / "a.rrd", scene)).stream().to_chunks():
        table = item.to_record_batch()
        kept = [name for name in table.schema.names if name == "time" or ":" in name]  # not the clock's
        for row in table.select(kept).to_pylist():
            found.setdefault(item.entity_path, []).append(row)
    names = {"/scene/shape", "/scene/surface", "/scene/all\\ the\\ data", "/scene/limbs", "/scene", "/about"}
    assert {name for name in found if not name.startswith("/__")} == names
    assert [row["time"].total_seconds() for row in found["/scene/limbs"]] == [0, 0.5, 1]
    rows = [row for row in found["/scene/shape"] if row.get("Mesh3D:vertex_positions")]
    assert len(rows) == 2  # the shape was not found in the last frame
    np.testing.assert_allclose(rows[1]["Mesh3D:vertex_positions"], moving[1], atol=1e-6)
    np.testing.assert_allclose(found["/scene/limbs"][2]["LineStrips3D:strips"], layers[4].points(2), atol=1e-6)
    assert found["/about"][0]["TextDocument:text"] == ["a title\nstatus: converged"]


def test_missing_packages_are_named_with_their_extra(tmp_path, monkeypatch):
    scene, real = Scene("points", (Cloud("data", [torch.eye(3)], (0.0, 0.0, 0.0)),)), builtins.__import__
    with pytest.raises(InputError, match=r"path must end in \.rrd"):
        rerun_log.scene_rrd(tmp_path / "a.html", scene)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"torchreg-articulated\[rerun\]"):
        rerun_log.scene_rrd(tmp_path / "a.rrd", scene)

    def without(name, *arguments, **options):
        if name == "viser":
            raise ImportError("no viser")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchreg-articulated\[viewer\]'"):
        SceneViewer(scene, port=0)


@pytest.fixture(scope="module")
def served():
    cloud = Cloud("data", [torch.eye(3), torch.eye(3) + 1], (0.0, 0.0, 0.0))
    with SceneViewer(Scene("two", (cloud,), SOON), port=0) as page:
        yield page


@pytest.fixture
def status(served):
    """Return the function that gives the status code of a request."""
    port = served.server.get_port()

    def status(path, **headers):
        headers = {"Host": f"{HOST}:{port}"} | {name.replace("_", "-"): text for name, text in headers.items()}
        lines = [f"GET {path} HTTP/1.1", *(f"{name}: {text}" for name, text in headers.items()), "", ""]
        with socket.create_connection((HOST, port), timeout=10) as line:
            line.sendall("\r\n".join(lines).encode())
            return int(line.recv(4096).split()[1])

    status.port, status.path = port, served.url.removeprefix(f"http://{HOST}:{port}")
    return status


def test_the_printed_address_is_the_only_one_that_lets_in(status):
    port, path, token = status.port, status.path, status.path.partition("token=")[2]
    assert len(token) > 20
    assert status(path) == 200
    assert status(path, **UPGRADE) == 101
    assert status(path, Origin=f"http://{HOST}:{port}", **UPGRADE) == 101
    assert status(path, Host=f"localhost:{port}", Origin=f"http://localhost:{port}", **UPGRADE) == 101
    assert status("/", Cookie=f"a=b; torchreg_{port}={token}", **UPGRADE) == 101
    for wrong in ("/", "/index.html", "/?token=", "/?token=" + token[:-1], "/?token=%00", "/?tok=" + token):
        assert status(wrong) == 403
        assert status(wrong, **UPGRADE) == 403
    assert status("/", Cookie=f"torchreg_{port + 1}={token}", **UPGRADE) == 403
    # The guard is of our servers alone.
    assert websocket_server.serve.__module__.startswith("websockets")


@each(
    *({"Origin": origin} for origin in ("null", "http://evil.example", "https://127.0.0.1:{port}")),
    *({"Origin": origin} for origin in ("http://127.0.0.1", "file://", "http://127.0.0.1:1")),
    *({"Host": host} for host in ("evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1.evil.io:{port}")),
)
def test_other_origins_and_hosts_are_refused_even_with_the_token(status, header):
    header = {name: text.format(port=status.port) for name, text in header.items()}
    assert status(status.path, **header, **UPGRADE) == 403
    if "Host" in header:
        assert status(status.path, **header) == 403


def test_it_listens_on_the_loopback_alone(served):
    others = {row[4][0] for row in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {HOST}
    for address in others:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, served.server.get_port()), timeout=1)


def messages(page):
    """Yield what a page may send: damaged bytes, unknown types, and controls set to what no page sets."""
    yield from (b"", b"\xff" * 100, b"\x80", msgspec.msgpack.encode({"type": "NoSuchMessage"}), b"\xc1")
    for value in (float("nan"), float("inf"), -1e300, 10**9, -5, "text", None, [], {"a": 1}, 2**63):
        for handle in page.server.gui._gui_input_handle_from_uuid:
            yield msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": handle, "updates": {"value": value}})
    yield msgspec.msgpack.encode({"type": "ScenePointerMessage", "event_type": "click", "ray_origin": "x"})


def test_no_message_stops_the_server(served, status):
    address = served.url.replace("http:", "ws:")
    served._timeline.play()
    for message in messages(served):
        with connect(address, subprotocols=[UPGRADE["Sec-WebSocket-Protocol"]]) as page:
            try:
                page.send(message)
                page.recv(timeout=0.02)
            except (TimeoutError, ConnectionClosed):
                pass
    assert status(status.path) == 200
    served._timeline.pause()
    served.show(0)
    served._timeline.play()
    assert wait_for(lambda: served.frame == 1)
    assert wait_for(lambda: served.frame == 0)
    served._timeline.pause()
