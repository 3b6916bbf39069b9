"""Pictures of spines: limbs in colors that stay, what was carried over dashed, one picture per frame, a movie."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.measurements import measure_limbs
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.figures import draw_scene, scene_view
from torchreg.viz.plots import plot
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.spines import draw_measurements, save_spine_movie, save_spine_pictures, tip_distance_paint

SPHERE = unit_sphere(2)


@pytest.mark.parametrize("frames", [1, 3])
def test_measurements_are_drawn_over_time_in_the_colors_of_limbs(frames):
    curves = torch.eye(3)[:, None] * torch.linspace(0.9, 0, 5)[:, None]
    curves = curves * torch.linspace(1, 2, frames)[:, None, None, None]
    graph, times = torch.tensor([[0, 3], [1, 3], [2, 3]]), torch.linspace(0, 1, frames)
    found = measure_limbs(curves, torch.ones(frames, 3, 5), graph, times)
    figure = draw_measurements(found)
    lengths, _, angles = figure.axes
    assert [line.get_color() for line in lengths.lines] == bone_palette(3).tolist()
    for limb, line in enumerate(lengths.lines):
        np.testing.assert_allclose(line.get_xydata(), torch.stack((times, found.lengths[:, limb]), dim=1))
    # Both limbs of each of three pairs at right angles.
    assert len(angles.lines) == 6
    np.testing.assert_allclose(angles.lines[0].get_ydata(), 90, atol=1e-4)
    assert [text.get_text() for text in lengths.get_legend().get_texts()] == ["0", "1", "2"]


def test_limbs_keep_colors_and_numbers_and_transferred_ones_are_dashed(spine):
    own = torch.tensor([[True, True, True], [True, False, True], [True, True, True]])
    scene = result_scene(replace(spine, own=own), data=[SPHERE] * 3)
    view = scene_view(scene, size=(80, 60))
    for frame in range(2):
        ax = draw_scene(scene, frame, view=view)
        limbs = [line for line in ax.lines if len(line.get_xdata()) == 8]
        assert [line.get_linestyle() for line in limbs] == ["-" if seen else "--" for seen in own[frame].tolist()]
        assert [line.get_color() for line in limbs] == bone_palette(3).tolist()
        for line, curve in zip(limbs, spine.curves[frame], strict=True):
            np.testing.assert_allclose(line.get_xydata(), view.project(curve)[0], atol=1e-3)
        assert [text.get_text() for text in ax.texts] == ["0", "1", "2"]
        assert ax.images[0].get_array()[..., 3].max() < 0.6  # limbs are seen through the surface


def test_one_picture_per_frame_and_a_movie(spine, tmp_path):
    meshes, told = [SPHERE] * 3, []
    view = scene_view(result_scene(spine, data=meshes), size=(80, 60))
    paths = save_spine_pictures(tmp_path / "a", spine, meshes, view=view, on_frame=lambda *n: told.append(n))
    assert [path.name for path in paths] == [f"frame_000{k}.png" for k in range(3)]
    assert told == [(1, 3), (2, 3), (3, 3)]
    with Image.open(paths[0]) as first, Image.open(paths[2]) as last:
        assert first.size == last.size == (80, 60)
        assert first.tobytes() != last.tobytes()
    with Image.open(save_spine_movie(tmp_path / "a.gif", spine, meshes, view=view)) as image:
        assert image.n_frames == 3
    for few in ([SPHERE], []):
        with pytest.raises(InputError, match=r"one surface per frame \(3\)"):
            save_spine_movie(tmp_path / "b.gif", spine, few)


def test_a_single_skeleton_is_drawn_in_its_surface():
    ends = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 0.9, 0], [0, 0, 0.9]])
    ax = plot(Skeleton(ends, [[0, 1], [0, 2], [0, 3]], torch.ones(4)), SPHERE)
    assert [line.get_color() for line in ax.lines if len(line.get_xdata()) > 1] == bone_palette(3).tolist()
    assert len(ax.images) == 1


def test_distances_from_a_tip_go_from_cold_to_warm_and_levels_alternate():
    ball = unit_sphere(4)
    order = ball.vertices[:, 2].argsort(descending=True)  # away from the tip
    paint = tip_distance_paint(ball, torch.tensor([0.0, 0.0, 2.0]))[order]
    assert paint[0, 2] > paint[0, 0]
    assert paint[-1, 0] > paint[-1, 2]
    striped = tip_distance_paint(ball, torch.tensor([0.0, 0.0, 2.0]), 6)[order]
    assert len(striped.unique(dim=0)) == 6
    brightness = [striped[int(share * (len(striped) - 1))].amax() for share in (0.02, 0.15, 0.37, 0.63, 0.85, 0.98)]
    assert (torch.stack(brightness).diff().sign() == torch.tensor([-1, 1, -1, 1, -1])).all()
