"""Who gets in to a served page: its own address does; other origins, hosts and guesses do not."""

import socket
import time

import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser")

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from torchreg.viz.scene import Cloud, Scene
from torchreg.viz.viewer import SceneViewer
from torchreg.viz.viser_server import HOST

UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}


@pytest.fixture(scope="module")
def viewer():
    clouds = [torch.eye(3), torch.eye(3) + 1]
    with SceneViewer(
        Scene("two", (Cloud("data", clouds, (0.0, 0.0, 0.0)),), torch.tensor([0.0, 0.02])), port=0
    ) as made:
        yield made


@pytest.fixture
def status(viewer):
    """Return the function that gives the status code of a request."""
    port = viewer.server.get_port()

    def status(path, **headers):
        headers = {"Host": f"{HOST}:{port}"} | {name.replace("_", "-"): text for name, text in headers.items()}
        lines = [f"GET {path} HTTP/1.1", *(f"{name}: {text}" for name, text in headers.items()), "", ""]
        with socket.create_connection((HOST, port), timeout=10) as line:
            line.sendall("\r\n".join(lines).encode())
            return int(line.recv(4096).split()[1])

    return status


@pytest.fixture
def path(viewer):
    return viewer.url.removeprefix(f"http://{HOST}:{viewer.server.get_port()}")


def test_the_printed_address_is_the_only_one_that_lets_in(viewer, status, path):
    port = viewer.server.get_port()
    token = path.partition("token=")[2]
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


@pytest.mark.parametrize(
    "origin",
    ["null", "http://evil.example", "https://127.0.0.1:{port}", "http://127.0.0.1", "file://", "http://127.0.0.1:1"],
)
def test_pages_of_other_origins_are_refused_even_with_the_token(viewer, status, path, origin):
    assert status(path, Origin=origin.format(port=viewer.server.get_port()), **UPGRADE) == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1.evil.example:{port}"])
def test_names_that_lead_here_by_someone_elses_dns_are_refused(viewer, status, path, host):
    host = host.format(port=viewer.server.get_port())
    assert status(path, Host=host, **UPGRADE) == 403
    assert status(path, Host=host) == 403


def test_it_listens_on_the_loopback_alone(viewer):
    others = {row[4][0] for row in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {HOST}
    for address in others:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, viewer.server.get_port()), timeout=1)


def test_the_guard_is_of_our_servers_alone(viewer):
    from websockets.asyncio import server

    assert server.serve.__module__.startswith("websockets")


def messages(viewer):
    """Yield what a page may send: damaged bytes, unknown types, and controls set to what no page sets."""
    yield from (b"", b"\xff" * 100, b"\x80", msgspec.msgpack.encode({"type": "NoSuchMessage"}), b"\xc1")
    for value in (float("nan"), float("inf"), -1e300, 10**9, -5, "text", None, [], {"a": 1}, 2**63):
        for handle in viewer.server.gui._gui_input_handle_from_uuid:
            yield msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": handle, "updates": {"value": value}})
    yield msgspec.msgpack.encode({"type": "ScenePointerMessage", "event_type": "click", "ray_origin": "x"})


def test_nothing_that_a_message_holds_stops_the_server(viewer, status, path, capsys):
    address = viewer.url.replace("http:", "ws:")
    viewer._timeline.play()
    for message in messages(viewer):
        with connect(address, subprotocols=[UPGRADE["Sec-WebSocket-Protocol"]]) as page:
            try:
                page.send(message)
                page.recv(timeout=0.02)
            except (TimeoutError, ConnectionClosed):
                pass
    assert status(path) == 200
    viewer._timeline.pause()
    viewer.show(0)
    viewer._timeline.play()
    shown = set()
    for _ in range(300):
        shown.add(viewer.frame)
        time.sleep(0.01)
        if len(shown) == 2:
            break
    assert shown == {0, 1}
    viewer._timeline.pause()
