"""Pictures: surfaces are lit and opaque where they are, points and curves lie where the camera sees them."""

import math
import sys

import numpy as np
import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.visibility import aim
from torchreg.viz import figures
from torchreg.viz.figures import (
    bending_picture,
    draw_scene,
    new_figure,
    readme_picture,
    save_picture,
    scene_view,
    watch,
)
from torchreg.viz.plots import plot
from torchreg.viz.rendering import render_mesh
from torchreg.viz.scene import Cloud, Curves, MovingMesh, Scene

PNG = b"\x89PNG\r\n\x1a\n"
BALL = unit_sphere(3)


def png_size(path):
    content = path.read_bytes()
    assert content.startswith(PNG)
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")


def pixels(ax):
    ax.figure.canvas.draw()
    return np.asarray(ax.figure.canvas.buffer_rgba())[..., :3].astype(int)


def sphere_view(size=(120, 120)):
    return aim(BALL.vertices, torch.tensor([0.0, 0.0, 8.0]), parallel=True, size=size)


def test_a_sphere_is_lit_from_the_upper_left_and_transparent_around():
    picture = render_mesh(BALL, sphere_view())
    assert picture.shape == (60, 60, 4)
    opacity = picture[..., 3]
    assert float(opacity.sum()) == pytest.approx(math.pi * 30**2, rel=0.02)
    assert float(opacity[0, 0]) == 0
    brightness = picture[..., :3].mean(-1)
    assert brightness[18, 20] > brightness[42, 40] + 0.1
    assert 0 <= float(picture.min()) <= float(picture.max()) <= 1
    # Scans whose triangles face away look the same.
    turned = render_mesh(TriangleMesh(BALL.vertices, BALL.faces[:, [0, 2, 1]]), sphere_view())
    torch.testing.assert_close(turned, picture)
    away = TriangleMesh(BALL.vertices + 50, BALL.faces)
    assert float(render_mesh(away, sphere_view()).abs().max()) == 0


def test_an_outline_is_not_stained_by_the_background():
    picture = render_mesh(BALL, sphere_view(), torch.ones(642, 3))
    faint = (picture[..., 3] > 0.2) & (picture[..., 3] < 0.8)
    assert bool(faint.any())
    assert float(picture[faint][:, :3].min()) > 0.15


def test_paint_colors_vertices_all_or_places():
    red = torch.tensor([1.0, 0, 0])
    for paint in (red.expand(642, 3), (1.0, 0.0, 0.0), lambda face, share: red.expand(len(face), 3)):
        shown = render_mesh(BALL, sphere_view(), paint)[30, 30]
        assert shown[0] > 3 * shown[1]


def test_what_lies_deeper_is_darker():
    def plate(z, half):
        corners = torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
        return corners, torch.tensor([[0, 1, 2], [0, 2, 3]])

    (far, faces), (near, _) = plate(0.0, 1.0), plate(1.0, 0.3)
    mesh = TriangleMesh(torch.cat([far, near]), torch.cat([faces, faces + 4]))
    view = aim(mesh.vertices, torch.tensor([0.0, 0.0, -1.0]), parallel=True, size=(200, 200))
    brightness = render_mesh(mesh, view)[..., 0]
    assert brightness[50, 34] < brightness[50, 5] - 0.02


def test_watch_tells_measurements_from_objects():
    measured = watch(0.1 * BALL.vertices + torch.tensor([0.0, 0.0, 0.6]))
    assert measured.rotation[2, 2] > 0.8
    assert measured.rotation[1, 1] > 0.8
    assert watch(BALL.vertices).rotation[1, 2] < -0.8
    chosen = watch(BALL.vertices, camera=torch.tensor([0.0, 0.0, 9.0]), up=torch.tensor([1.0, 0, 0]), size=(30, 20))
    assert (chosen.width, chosen.height) == (60, 40)
    torch.testing.assert_close(chosen.rotation[1], torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))


def test_layers_are_drawn_upright_in_their_colors_on_given_axes():
    red = MovingMesh("low", BALL.vertices, BALL.faces, (1.0, 0.0, 0.0))
    blue = MovingMesh("high", BALL.vertices + torch.tensor([0.0, 3.0, 0.0]), BALL.faces, (0.0, 0.0, 1.0))
    scene = Scene("two balls", (red, blue), up=(0.0, 1.0, 0.0), captions=("a caption",))
    ax = draw_scene(scene)
    drawn = pixels(ax)
    rows = [np.nonzero((drawn[..., one] - drawn[..., other]) > 60)[0].mean() for one, other in ((0, 2), (2, 0))]
    assert rows[1] < rows[0]
    assert ax.get_title() == "two balls"
    assert [text.get_text() for text in ax.texts] == ["a caption"]
    assert not ax.axison
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()
    _, axes = new_figure(100, 40, 2)
    assert draw_scene(scene, ax=axes[1], size=(50, 40)) is axes[1]
    assert (axes[1].get_xlim(), axes[1].get_ylim()) == ((0, 100), (80, 0))


def test_points_lie_where_the_camera_sees_them_and_are_pale_behind_a_surface():
    places = torch.tensor([[0.0, 0, 1.1], [0.0, 0, -1.1], [1.2, 0, 0], [0, 0, 50.0]])
    line = torch.tensor([[[0.0, 0, 1.2], [1.0, 1, 1]]])
    layers = (
        MovingMesh("ball", BALL.vertices, BALL.faces),
        Cloud("data", [places], [torch.eye(4, 3)]),
        Curves("line", line, torch.tensor([[0.2, 0.4, 0.6]]), labels=("tip",)),
        Cloud("hidden", [places], (0.0, 0.0, 0.0), visible=False),
    )
    scene = Scene("ball", layers)
    view = scene_view(scene, camera=torch.tensor([0.0, 0, 8]), size=(60, 60))
    ax = draw_scene(scene, view=view)
    (dots,) = ax.collections
    order = [1, 0, 2]  # those in front last; what is behind the camera not at all
    np.testing.assert_allclose(dots.get_offsets(), view.project(places.double())[0][order], atol=1e-3)
    np.testing.assert_allclose(dots.get_facecolor()[:, :3], torch.eye(4, 3)[order])
    assert dots.get_facecolor()[0, 3] < 0.5
    assert dots.get_facecolor()[1:, 3].tolist() == [1, 1]
    np.testing.assert_allclose(ax.lines[0].get_xydata(), view.project(line[0])[0], atol=1e-3)


def test_every_kind_of_result_has_a_picture(registration, sequence, spine, starts, hand, alignment, clouds, track):
    for result, options in ((registration, {}), (sequence, {}), (spine, {}), (starts, {"shape": hand, "frame": 0})):
        assert float((pixels(plot(result, **options)) < 250).any(-1).mean()) > 0.003
    assert "degrees of freedom" in plot(hand).get_title()
    assert plot(torch.rand(50, 3)).get_title() == "50 points"
    assert len(alignment.plot(clouds[0], shape=hand).collections) == 1
    with pytest.raises(InputError, match="frame must be from 0 to 2, got 3"):
        plot(track, shape=hand, frame=3)
    with pytest.raises(InputTypeError, match="must be one that can be shown"):
        plot("hand")


def test_save_picture_refuses_unknown_formats_and_missing_folders(tmp_path):
    figure, _ = new_figure(20, 20)
    with pytest.raises(InputError, match=r"path must end in \.png, \.pdf or \.svg, got 'a\.xyz'"):
        save_picture(figure, tmp_path / "a.xyz")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        save_picture(figure, tmp_path / "none" / "a.png")
    assert png_size(save_picture(figure, tmp_path / "a.png", dpi=200)) == (40, 40)


def test_bending_picture_shows_a_finger_per_sharpness(tmp_path):
    path = bending_picture(tmp_path / "bend.png", (2.0, 10.0))
    assert png_size(path) == (800, 400)
    assert path.stat().st_size < 200_000
    with pytest.raises(InputError, match="sharpness must hold at least one number"):
        bending_picture(path, ())
    with pytest.raises(InputError, match="sharpness must be positive"):
        bending_picture(path, (-1.0,))


def test_a_dull_skin_stretches_over_a_wider_bend_than_a_sharp_one():
    finger = figures._finger()
    mesh = finger.surface_mesh(spacing=0.003)

    def bent_share(sharpness):
        weights = figures.BendingSkin(finger, mesh.vertices, sharpness=sharpness).weights
        return float(((weights > 0.05) & (weights < 0.95)).any(-1).float().mean())

    assert bent_share(2.0) > 2 * bent_share(10.0) > 0


def test_readme_picture_is_small(tmp_path):
    path = readme_picture(tmp_path / "readme.png")
    assert png_size(path) == (1200, 400)
    assert path.stat().st_size < 200_000
