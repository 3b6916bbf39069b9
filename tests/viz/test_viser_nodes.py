"""Frames and toggles reach the nodes of a page."""

import numpy as np
import pytest
import torch

from torchreg.geometry.mesh import unit_sphere
from torchreg.viz.scene import Cloud, Curves, Meshes, MovingMesh, Scene
from torchreg.viz.viser_nodes import DrawnScene, as_floats
from torchreg.viz.viser_server import start_server, stop_server

pytest.importorskip("viser", reason="the viewer needs viser")
BALL = unit_sphere(1)


@pytest.fixture(scope="module")
def server():
    server = start_server("nodes", 0)
    yield server
    stop_server(server)


def test_every_layer_goes_from_frame_to_frame(server):
    moving = torch.stack([torch.full_like(BALL.vertices, torch.nan), BALL.vertices])
    curves = torch.stack([torch.zeros(2, 3, 3), torch.arange(18.0).reshape(2, 3, 3)])
    clouds = [BALL.vertices[:0], BALL.vertices]
    scene = Scene(
        "all",
        (
            MovingMesh("plain", moving, BALL.faces, opacity=0.5),
            MovingMesh("painted", BALL.vertices, BALL.faces, (BALL.vertices + 1) / 2),
            Meshes("meshes", [unit_sphere(0), BALL]),
            Cloud("cloud", clouds, [cloud.abs() for cloud in clouds]),
            Curves("curves", curves, torch.eye(3)[:2], labels=("tip",)),
            Cloud("hidden", [BALL.vertices], (1.0, 0.0, 0.0), visible=False),
        ),
    )
    drawn = DrawnScene(server.scene, scene)

    def node(name):
        return server.scene.get_handle_by_name(f"/layers/{name}")

    assert [node(name).visible for name in ("0/0", "1/0", "2/0", "2/1", "3", "4/lines", "5")] == [
        False, True, True, False, False, True, False,
    ]  # fmt: skip
    drawn.show(1)
    assert drawn.frame == 1
    assert [node(name).visible for name in ("0/0", "1/0", "2/0", "2/1", "3", "4/lines", "5")] == [
        True, True, False, True, True, True, False,
    ]  # fmt: skip
    np.testing.assert_array_equal(node("0/0").vertices, BALL.vertices)
    np.testing.assert_array_equal(node("3").points, BALL.vertices)
    pieces = torch.stack([curves[1, limb, [step, step + 1]] for limb in range(2) for step in range(2)])
    np.testing.assert_array_equal(node("4/lines").points, pieces)
    np.testing.assert_array_equal(node("4/label_0").position, curves[1, 0, 0])
    drawn.set_visible("plain", False)
    drawn.set_visible("hidden", True)
    assert not node("0/0").visible
    assert node("5").visible
    server.scene.reset()


def test_patches_of_paint_make_up_the_surface(server):
    scene = Scene("painted", (MovingMesh("ball", BALL.vertices, BALL.faces, (BALL.vertices + 1) / 2),))
    DrawnScene(server.scene, scene)
    number, faces = 0, 0
    while (node := server.scene.get_handle_by_name(f"/layers/0/{number}")) is not None:
        number, faces = number + 1, faces + len(node.faces)
    assert number == len(scene.layers[0].patches())
    assert faces == BALL.num_faces
    server.scene.reset()


def test_numbers_for_pages():
    values = as_floats(torch.ones(2, dtype=torch.float64, requires_grad=True))
    assert values.dtype == np.float32
