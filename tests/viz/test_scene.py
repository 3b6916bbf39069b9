"""Scenes as data: what must fit, patches of one color, cameras that see everything."""

import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.viz.scene import FIELD_OF_VIEW, Cloud, Curves, Meshes, MovingMesh, Scene

BALL = unit_sphere(2)
POINTS = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))


def test_patches_hold_every_face_once_with_its_color():
    paint = (BALL.vertices + 1) / 2
    surface = MovingMesh("ball", BALL.vertices, BALL.faces, paint)
    patches = surface.patches()
    assert 1 < len(patches) <= 48
    found = torch.cat([used[faces] for used, faces, _ in patches])
    key = lambda faces: sorted(tuple(sorted(row)) for row in faces.tolist())  # noqa: E731
    assert key(found) == key(BALL.faces)
    for used, faces, color in patches:
        assert int(faces.max()) == len(used) - 1
        assert (paint[used[faces]].mean(1) - torch.tensor(color)).abs().max() < 0.35
    assert len(surface.patches(most=8)) <= 8
    ((used, faces, color),) = MovingMesh("ball", BALL.vertices, BALL.faces, (1.0, 0.0, 0.5)).patches()
    assert torch.equal(used[faces], BALL.faces)
    assert color == (1.0, 0.0, 0.5)


def test_a_painted_surface_without_faces_has_no_patches():
    nothing = MovingMesh("empty", BALL.vertices, BALL.faces[:0], torch.zeros_like(BALL.vertices))
    assert nothing.patches() == []


def test_layers_that_stand_still_are_shown_in_every_frame():
    moving = torch.stack([BALL.vertices, BALL.vertices + 1])
    scene = Scene("two", (MovingMesh("ball", moving, BALL.faces), Cloud("still", [POINTS], (1.0, 0.0, 0.0))))
    assert scene.num_frames == 2
    assert scene.seconds == [0.0, 0.05]
    assert torch.equal(scene.layer("ball").points(1), moving[1])
    assert torch.equal(scene.layer("still").points(1), POINTS)
    assert torch.equal(scene.layer("still").paint(1), torch.tensor([1.0, 0, 0]).expand(20, 3))
    assert Scene("timed", scene.layers, torch.tensor([3.0, 4.5])).seconds == [0.0, 1.5]
    with pytest.raises(InputError, match="no layer 'cube'; it has ball, still"):
        scene.layer("cube")


def test_curves_move():
    curves = torch.arange(24.0).reshape(2, 4, 3)
    layer = Curves("limbs", curves, torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]))
    assert torch.equal(layer.points(0), curves)
    moving = Curves("limbs", torch.stack([curves, curves + 1]), layer.paint)
    assert torch.equal(moving.points(1), curves + 1)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.0, 0.0, 8.0), (0.3, -4.0, 5.0)])
@pytest.mark.parametrize("up", [None, (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
def test_the_camera_sees_everything(offset, up):
    points = BALL.vertices * torch.tensor([1.0, 0.4, 0.6]) + torch.tensor(offset)
    scene = Scene("ball", (MovingMesh("ball", points, BALL.faces),), up=up)
    position, target, upright = scene.camera()
    forward = (target - position) / (target - position).norm()
    rays = points.double() - position
    angle = torch.acos(((rays / rays.norm(dim=-1, keepdim=True)) @ forward).clamp(-1, 1))
    assert float(angle.max()) < FIELD_OF_VIEW / 2
    assert float(torch.linalg.cross(forward, upright).norm()) > 0.5
    if up is None:
        assert upright.tolist() == ([0, -1, 0] if math.hypot(*offset) > 1 else [0, 0, 1])
    else:
        assert upright.tolist() == list(up)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-0.6, 0.0, -0.8)])
def test_a_scan_from_one_side_is_seen_from_there(direction):
    towards = torch.tensor(direction)
    seen = (BALL.vertices[BALL.faces].mean(1) @ towards) > 0.2
    scan = MovingMesh("scan", BALL.vertices, BALL.faces[seen])
    for up in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
        position, target, _ = Scene("scan", (scan,), up=up).camera()
        looking = (position - target) / (position - target).norm()
        assert float(looking @ towards.double()) > 0.8
        assert float(looking[1] * up[1]) > 0.1  # from above


def test_outliers_do_not_decide_where_the_camera_stands():
    far = Cloud("data", [100 * POINTS], (0.0, 0.0, 0.0))
    ball = Meshes("ball", [BALL])
    assert Scene("both", (ball, far)).diagonal == pytest.approx(Scene("one", (ball,)).diagonal)
    assert Scene("points", (far,)).diagonal > 50
    hidden = MovingMesh("hidden", torch.full((4, 3), torch.nan), BALL.faces[:0], visible=False)
    assert Scene("nothing", (hidden,)).diagonal == 1.0


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="paint of ball"):
        MovingMesh("ball", BALL.vertices, BALL.faces, POINTS)
    with pytest.raises(InputError, match=r"frames\[0\] of data"):
        Cloud("data", [POINTS[:, :2]], (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="paints of data must be 1"):
        Cloud("data", [POINTS], [POINTS, POINTS])
    with pytest.raises(InputError, match=r"paints\[0\] of data"):
        Cloud("data", [POINTS], [POINTS[:3]])
    with pytest.raises(InputError, match="labels of limbs"):
        Curves("limbs", torch.zeros(1, 2, 3), torch.zeros(1, 3), labels=("a", "b"))
    ball = MovingMesh("ball", BALL.vertices, BALL.faces)
    with pytest.raises(InputError, match="different names"):
        Scene("twice", (ball, ball))
    with pytest.raises(InputError, match="got none"):
        Scene("empty", ())
    with pytest.raises(InputError, match="one number of frames, got 2, 3"):
        Scene("uneven", (Meshes("two", [BALL] * 2), Meshes("three", [BALL] * 3)))
    with pytest.raises(InputError, match="times"):
        Scene("late", (ball,), torch.arange(2.0))
