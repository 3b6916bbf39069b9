"""Pictures of spines: limbs in colors that stay, what was carried over dashed, one picture per frame, a movie."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.measurements import measure_limbs
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.figures import new_figure
from torchreg.viz.spines import (
    draw_measurements,
    draw_spine_frame,
    draw_tip_distance,
    save_skeleton_picture,
    save_spine_movie,
    save_spine_pictures,
    spine_view,
)

SPHERE = unit_sphere(2)


@pytest.fixture
def spine():
    ends = torch.eye(3)
    curves = ends[:, None] * torch.linspace(0.9, 0, 5)[:, None]
    turned = curves.roll(1, -1)
    own = torch.tensor([[True, True, True], [True, False, True]])
    return SimpleNamespace(curves=torch.stack((curves, turned)), num_tips=3, own=own, up=None)


@pytest.mark.parametrize("frames", [1, 3])
def test_measurements_are_drawn_over_time_in_the_colors_of_limbs(spine, frames):
    curves = spine.curves[:1] * torch.linspace(1, 2, frames)[:, None, None, None]
    graph, times = torch.tensor([[0, 3], [1, 3], [2, 3]]), torch.linspace(0, 1, frames)
    found = measure_limbs(curves, torch.ones(frames, 3, 5), graph, times)
    figure = draw_measurements(found)
    lengths, _, angles = figure.axes
    colors = bone_palette(3).tolist()
    assert [line.get_color() for line in lengths.lines] == colors
    for limb, line in enumerate(lengths.lines):
        np.testing.assert_allclose(line.get_xydata(), torch.stack((times, found.lengths[:, limb]), dim=1))
    # Both limbs of each of three pairs at right angles.
    assert len(angles.lines) == 6
    np.testing.assert_allclose(angles.lines[0].get_ydata(), 90, atol=1e-4)
    assert [text.get_text() for text in lengths.get_legend().get_texts()] == ["0", "1", "2"]


def test_limbs_keep_their_colors_and_transferred_ones_are_dashed(spine):
    view = spine_view([SPHERE], size=(160, 120))
    for frame in range(2):
        _, (ax,) = new_figure(80, 60)
        draw_spine_frame(ax, SPHERE, spine.curves[frame], 3, view=view, transferred=~spine.own[frame])
        limbs = [line for line in ax.lines if len(line.get_xdata()) == 5]
        assert [line.get_linestyle() for line in limbs] == ["-" if own else "--" for own in spine.own[frame].tolist()]
        for line, color in zip(limbs, bone_palette(3).tolist(), strict=True):
            assert line.get_color() == color
        assert [text.get_text() for text in ax.texts] == ["0", "1", "2"]
        assert ax.images[0].get_array()[..., 3].max() < 0.6


def test_one_picture_per_frame_and_a_movie(spine, tmp_path):
    view, told = spine_view([SPHERE], size=(160, 120)), []
    paths = save_spine_pictures(
        tmp_path / "frames", spine, [SPHERE, SPHERE], view=view, on_frame=lambda *n: told.append(n)
    )
    assert [path.name for path in paths] == ["frame_0000.png", "frame_0001.png"]
    assert told == [(1, 2), (2, 2)]
    with Image.open(paths[0]) as first, Image.open(paths[1]) as second:
        assert first.size == second.size
        assert first.tobytes() != second.tobytes()
    movie = save_spine_movie(tmp_path / "a.gif", spine, [SPHERE, SPHERE], view=view)
    with Image.open(movie) as image:
        assert image.n_frames == 2


def test_a_single_skeleton_is_drawn_in_its_surface(tmp_path):
    ends = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 0.9, 0], [0, 0, 0.9]])
    skeleton = Skeleton(ends, [[0, 1], [0, 2], [0, 3]], torch.ones(4))
    view = spine_view([SPHERE], size=(160, 120))
    with Image.open(save_skeleton_picture(tmp_path / "a.png", SPHERE, skeleton, view=view)) as image:
        shown = image.convert("RGB")
    assert shown.size == (160, 120)
    # Colors of limbs in a gray body.
    pixels = torch.from_numpy(np.array(shown)).reshape(-1, 3).int()
    assert int((pixels.amax(1) - pixels.amin(1) > 60).sum()) > 20
    with pytest.raises(InputError, match="single node"):
        save_skeleton_picture(tmp_path / "b.png", SPHERE, Skeleton(ends[:1], [], torch.ones(1)))


def test_every_frame_needs_its_surface(spine, tmp_path):
    with pytest.raises(InputError, match=r"one surface per frame \(2\), got 1"):
        save_spine_movie(tmp_path / "a.gif", spine, [SPHERE])


def test_distances_from_a_tip_go_from_cold_to_warm_and_levels_alternate():
    ball, tip = unit_sphere(4), torch.tensor([0.0, 0.0, 2.0])
    view, pictures = spine_view([ball], size=(320, 320)), {}
    for levels in (None, 6):
        _, (ax,) = new_figure(160, 160)
        draw_tip_distance(ax, ball, tip, view=view, levels=levels)
        picture = np.asarray(ax.images[0].get_array())
        solid = np.flatnonzero(picture[:, picture.shape[1] // 2, 3] > 0.95)
        pictures[levels] = picture[solid[6] : solid[-6], picture.shape[1] // 2, :3]
    # The picture shows +z above: blue near the tip, red far from it.
    (red, _, blue), (far_red, _, far_blue) = pictures[None][0], pictures[None][-1]
    assert blue > red
    assert far_red > far_blue

    def peaks(column):
        smooth = np.convolve(column.sum(-1), np.ones(5) / 5, "valid")
        return int(((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] > smooth[2:])).sum())

    assert peaks(pictures[6]) > peaks(pictures[None])
