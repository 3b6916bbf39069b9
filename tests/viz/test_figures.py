import math
import sys

import pytest
import torch

from torchreg.datasets.hand import surface_skin
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.visibility import aim
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.viz import figures
from torchreg.viz.figures import (
    bending_picture,
    draw_alignment,
    draw_points,
    new_figure,
    posed_mesh,
    readme_picture,
    render_mesh,
    save_picture,
    watch,
)

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def hand():
    return Hand()


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.008)


def png_size(path):
    content = path.read_bytes()
    assert content.startswith(PNG)
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")


def sphere_view(size=(120, 120)):
    return aim(unit_sphere(3).vertices, torch.tensor([0.0, 0.0, 8.0]), parallel=True, size=size)


def test_a_sphere_is_lit_from_the_upper_left_and_transparent_around():
    picture = render_mesh(unit_sphere(3), sphere_view())
    assert picture.shape == (60, 60, 4)
    opacity = picture[..., 3]
    assert float(opacity.sum()) == pytest.approx(math.pi * 30**2, rel=0.02)
    assert float(opacity[0, 0]) == 0
    brightness = picture[..., :3].mean(-1)
    assert brightness[18, 20] > brightness[42, 40] + 0.1
    assert 0 <= float(picture.min()) <= float(picture.max()) <= 1


def test_an_outline_is_not_stained_by_the_background():
    picture = render_mesh(unit_sphere(3), sphere_view(), torch.ones(642, 3))
    faint = (picture[..., 3] > 0.2) & (picture[..., 3] < 0.8)
    assert bool(faint.any())
    assert float(picture[faint][:, :3].min()) > 0.15


def test_paint_colors_vertices_or_pixels():
    sphere = unit_sphere(3)
    view = sphere_view()
    red = torch.zeros(642, 3)
    red[:, 0] = 1
    by_vertex = render_mesh(sphere, view, red)[30, 30]
    assert by_vertex[0] > 3 * by_vertex[1]
    green = torch.zeros(120, 120, 3)
    green[..., 1] = 1
    by_pixel = render_mesh(sphere, view, green)[30, 30]
    assert by_pixel[1] > 3 * by_pixel[0]


def test_what_lies_deeper_is_darker():
    def plate(z, half):
        corners = torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
        return corners, torch.tensor([[0, 1, 2], [0, 2, 3]])

    (far, faces), (near, _) = plate(0.0, 1.0), plate(1.0, 0.3)
    mesh = TriangleMesh(torch.cat([far, near]), torch.cat([faces, faces + 4]))
    view = aim(mesh.vertices, torch.tensor([0.0, 0.0, -1.0]), parallel=True, size=(200, 200))
    brightness = render_mesh(mesh, view)[..., 0]
    beside, apart = brightness[50, 34], brightness[50, 5]
    assert beside < apart - 0.02


def test_render_mesh_of_nothing_in_sight_is_empty():
    away = TriangleMesh(unit_sphere(1).vertices + 50, unit_sphere(1).faces)
    assert float(render_mesh(away, sphere_view()).abs().max()) == 0


def test_watch_tells_measurements_from_objects():
    points = unit_sphere(1).vertices
    measured = watch(0.1 * points + torch.tensor([0.0, 0.0, 0.6]))
    assert measured.rotation[2, 2] > 0.8
    assert measured.rotation[1, 1] > 0.8
    model = watch(points)
    assert model.rotation[1, 2] < -0.8
    chosen = watch(points, camera=torch.tensor([0.0, 0.0, 9.0]), up=torch.tensor([1.0, 0.0, 0.0]), size=(30, 20))
    assert (chosen.width, chosen.height) == (60, 40)
    torch.testing.assert_close(chosen.rotation[1], torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))


def test_draw_alignment_makes_a_figure_of_its_own(hand, skin, tmp_path):
    pose = hand.rest_pose()
    data = skin.points[::20] + torch.tensor([0.0, -0.002, 0.0])
    ax = draw_alignment(None, hand, pose, data, data[:, 0] > 0, skin=skin)
    path = save_picture(ax.figure, tmp_path / "a.png")
    assert png_size(path) == (480, 480)
    assert len(ax.images) == 1
    assert not ax.axison


def test_inliers_outliers_and_hidden_points_look_different(hand, skin):
    mesh = posed_mesh(hand, hand.rest_pose(), skin)
    view = watch(mesh.vertices, camera=torch.tensor([0.0, -0.6, 0.1]), up=torch.tensor([0.0, 0.0, 1.0]))
    data = torch.tensor([[0.0, -0.05, 0.05], [0.0, 0.05, 0.05], [0.0, -0.06, 0.04], [0.0, 0.06, 0.04]])
    _, (ax,) = new_figure(100, 100)
    draw_points(ax, mesh, view, data, torch.tensor([True, True, False, False]))
    outlier, hidden, inlier = ax.collections
    assert inlier.get_alpha() > hidden.get_alpha()
    assert outlier.get_facecolor()[0][:3].tolist() != inlier.get_facecolor()[0][:3].tolist()
    pixels, _ = view.project(data)
    torch.testing.assert_close(torch.as_tensor(inlier.get_offsets().data), pixels[:1])
    torch.testing.assert_close(torch.as_tensor(hidden.get_offsets().data), pixels[1:2])
    torch.testing.assert_close(torch.as_tensor(outlier.get_offsets().data), pixels[2:3])


def test_drawing_on_given_axes_with_a_view_and_without_data(hand, skin):
    view = watch(skin.points, size=(50, 40))
    _, axes = new_figure(100, 40, 2)
    assert draw_alignment(axes[1], hand, hand.rest_pose(), skin=skin, view=view) is axes[1]
    assert axes[1].get_xlim() == (0, 100)
    assert axes[1].get_ylim() == (80, 0)
    assert not axes[1].collections


def test_unknown_data_have_a_color_of_their_own(hand, skin):
    data = skin.points[::40]
    known = draw_alignment(None, hand, hand.rest_pose(), data, torch.ones(len(data), dtype=torch.bool), skin=skin)
    unknown = draw_alignment(None, hand, hand.rest_pose(), data, skin=skin)
    colors = [ax.collections[-1].get_facecolor()[0][:3].tolist() for ax in (known, unknown)]
    assert colors[0] != colors[1]


def test_drawing_leaves_pyplot_alone(hand, skin):
    draw_alignment(None, hand, hand.rest_pose(), skin=skin)
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": torch.zeros(4, 2)}, "data must have shape"),
        ({"data": torch.zeros(4, 3), "inliers": torch.ones(3, dtype=torch.bool)}, r"inliers must have shape \(4\)"),
        ({"data": torch.zeros(4, 3), "inliers": torch.ones(4)}, "inliers must be bool"),
        ({"pose": torch.zeros(2, 27)}, r"pose must have shape \(27\)"),
    ],
)
def test_draw_alignment_refuses(hand, skin, options, message):
    with pytest.raises(InputError, match=message):
        draw_alignment(None, **{"shape": hand, "pose": hand.rest_pose(), "skin": skin, **options})


def test_a_skin_without_faces_is_refused(hand, skin):
    bare = LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())
    with pytest.raises(InputError, match="skin must have faces"):
        posed_mesh(hand, hand.rest_pose(), bare)


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
    pose = finger.rest_pose()
    pose[6:] = math.radians(80)

    def bent_share(sharpness):
        weights = figures.BendingSkin(finger, mesh.vertices, sharpness=sharpness).weights
        return float(((weights > 0.05) & (weights < 0.95)).any(-1).float().mean())

    assert bent_share(2.0) > 2 * bent_share(10.0) > 0


def test_readme_picture_is_small(tmp_path):
    path = readme_picture(tmp_path / "readme.png")
    assert png_size(path) == (1200, 400)
    assert path.stat().st_size < 200_000
