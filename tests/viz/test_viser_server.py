"""Servers are reached from this machine alone, make no noise, and say which extra is missing."""

import builtins
import urllib.request

import pytest
import torch

from torchreg.errors import MissingExtraError
from torchreg.viz.scene import Cloud, Scene
from torchreg.viz.viser_server import HOST, import_viser, page_url, point_camera, start_server, stop_server


def test_a_server_listens_here_alone_and_shares_nothing(capsys):
    pytest.importorskip("viser", reason="the viewer needs viser")
    server = start_server("a title", 0)
    assert page_url(server).startswith(f"http://{HOST}:")
    assert server.get_host() == HOST == "127.0.0.1"
    assert server.request_share_url() is None
    with urllib.request.urlopen(page_url(server), timeout=10) as page:
        assert page.status == 200
    stop_server(server)
    assert capsys.readouterr().out == ""


def test_the_camera_is_that_of_the_scene():
    pytest.importorskip("viser", reason="the viewer needs viser")
    scene = Scene("points", (Cloud("data", [torch.eye(3) + 5], (0.0, 0.0, 0.0)),))
    server = start_server("a title", 0)
    point_camera(server, scene)
    position, target, up = scene.camera()
    assert server.initial_camera.position == pytest.approx(position.tolist())
    assert server.initial_camera.look_at == pytest.approx(target.tolist())
    assert server.initial_camera.up == pytest.approx(up.tolist())
    stop_server(server)


def test_without_viser_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "viser":
            raise ImportError("no viser")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchreg-articulated\[viewer\]'"):
        import_viser()
