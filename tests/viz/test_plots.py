"""Results plot themselves: what is drawn lies where the scene's camera sees it."""

import numpy as np
import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import unit_sphere
from torchreg.viz.plots import draw_scene, plot
from torchreg.viz.scene import Cloud, Curves, MovingMesh, Scene


def pixels(ax):
    ax.figure.canvas.draw()
    return np.asarray(ax.figure.canvas.buffer_rgba())[..., :3]


def test_results_of_scans_spines_and_searches_have_pictures(registration, sequence, spine, starts, hand):
    for result, options in ((registration, {}), (sequence, {}), (spine, {}), (starts, {"shape": hand, "frame": 0})):
        assert float((pixels(plot(result, **options)) < 250).any(-1).mean()) > 0.003


def test_layers_are_drawn_upright_in_their_colors():
    ball = unit_sphere(1)
    red = MovingMesh("low", ball.vertices, ball.faces, (1.0, 0.0, 0.0))
    blue = MovingMesh("high", ball.vertices + torch.tensor([0.0, 3.0, 0.0]), ball.faces, (0.0, 0.0, 1.0))
    ax = draw_scene(Scene("two balls", (red, blue), up=(0.0, 1.0, 0.0)), 0)
    drawn = pixels(ax).astype(int)
    rows = [np.nonzero((drawn[..., one] - drawn[..., other]) > 60)[0].mean() for one, other in ((0, 2), (2, 0))]
    assert rows[1] < rows[0]
    assert ax.get_title() == "two balls"


def test_clouds_and_curves_are_drawn():
    line = torch.stack([torch.linspace(0, 1, 5), torch.zeros(5), torch.zeros(5)], -1)
    scene = Scene("parts", (Curves("line", line[None], torch.eye(3)[:1]), Cloud("dots", [line + 0.2], (0.0, 0.0, 1.0))))
    ax = draw_scene(scene, 0)
    assert len(ax.lines) == 1
    assert len(ax.collections[0].get_offsets()) == 5


def test_shapes_scans_and_frames(hand, track):
    assert "degrees of freedom" in plot(hand).get_title()
    assert plot(torch.rand(50, 3)).get_title() == "50 points"
    last = len(track.poses) - 1
    with pytest.raises(InputError, match=f"frame must be from 0 to {last}, got {last + 1}"):
        plot(track, shape=hand, frame=last + 1)
    with pytest.raises(InputTypeError, match="must be one that can be shown"):
        plot("hand")


def test_a_result_plots_itself_with_its_data(alignment, hand, clouds):
    ax = alignment.plot(clouds[0], shape=hand)
    assert len(ax.collections) == 1
