"""A running tracker on a page: the shape where it is, gray where no data support it, nothing where it was not found."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from torchreg.errors import InputError
from torchreg.result import Status
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult
from torchreg.viz.live_track import LiveTrack
from torchreg.viz.posed_scenes import coarse_skin

pytest.importorskip("viser", reason="the viewer needs viser")


@pytest.fixture(scope="module")
def skin(hand):
    return coarse_skin(hand)


def frame_of(alignment, number, pose, status, acquired):
    known = {item.name: getattr(alignment, item.name) for item in fields(alignment)}
    known |= {"pose": pose, "status": status, "covariance": torch.eye(27)}
    return FrameResult(
        **known, acquired=acquired, frame=number, time=0.05 * number, inlier_ratio=0.5, residual=0.001
    )  # fmt: skip


def test_frames_are_shown_as_they_come(skin, alignment, track):
    data = alignment.registered.clone()
    data[0] = torch.nan
    with LiveTrack(skin, port=0) as page:
        assert page.url.startswith("http://127.0.0.1:")
        none = replace(
            frame_of(alignment, 0, track.poses[0], Status.LOST, "lost"), inliers=torch.zeros(0, dtype=torch.bool)
        )
        page.show(torch.zeros(0, 3), none)
        assert page.server.scene.get_handle_by_name("/data") is None
        page.show(data, frame_of(alignment, 1, track.poses[0], Status.LOST, "lost"))
        assert page.server.scene.get_handle_by_name("/shape") is None
        cloud = page.server.scene.get_handle_by_name("/data")
        assert len(cloud.points) == len(data) - 1
        page.show(data, frame_of(alignment, 2, track.poses[1], Status.CONVERGED, "found"))
        shape = page.server.scene.get_handle_by_name("/shape")
        np.testing.assert_allclose(shape.vertices, skin(track.poses[1]).detach(), atol=1e-6)
        fresh = tuple(shape.color)
        assert "found" in page._label.content
        page.show(data, frame_of(alignment, 3, track.poses[2], Status.LOST, "held"))
        assert tuple(shape.color) != fresh
        assert "lost" in page._label.content
        page.show(data, frame_of(alignment, 4, track.poses[0], Status.LOST, "lost"))
        assert not shape.visible


def test_a_skin_without_faces_is_refused(hand, skin):
    bare = LinearBlendSkin(hand, skin.points, skin.weights, skin.reference_pose)
    with pytest.raises(InputError, match="skin must have faces"):
        LiveTrack(bare, port=0)
