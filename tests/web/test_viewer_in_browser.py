"""The viewer in headless Chromium: every kind of result opens, is drawn and plays, and nothing leaves the machine."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

import torchreg as tr
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Scene
from torchreg.viz.viewer import SceneViewer, scene_html

BACKGROUND = 250


def track_scene():
    hand = tr.Hand().requires_grad_(False)
    poses = hand.rest_pose().repeat(4, 1)
    poses[:, 2], poses[:, 6:] = 0.5, torch.linspace(0, 0.6, 4)[:, None] * hand.upper[6:]
    ones, converged = torch.ones(4), (tr.Status.CONVERGED,) * 4
    track = tr.TrackResult(
        poses, torch.zeros_like(poses), hand.keypoints(poses), ones, ones, torch.arange(4.0) / 20, ones, converged,
        ("tracked",) * 4,
    )  # fmt: skip
    return result_scene(track, shape=hand, data=list(track.keypoints + 0.002))


@pytest.fixture
def spine_scene(spine, tools):
    return result_scene(spine, data=[tools.ball(2), tools.ball(3), tools.ball(3)])


def drawn(page):
    """Return which pixels of the scene, left of the controls, are not background."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    return (picture[150:, :560] < BACKGROUND).any(-1)


def wait_until_drawn(page, *, still=True):
    """Return the mask of the scene once there is one, and it no longer changes if it should stand still."""
    page.wait_for_selector("canvas")
    before = drawn(page)
    for _ in range(60):
        page.wait_for_timeout(250)
        mask = drawn(page)
        if mask.mean() > 0.005 and (not still or (mask == before).all()):
            break
        before = mask
    return mask


def wait_until_moved(page, first):
    """Return how many pixels are not as they were; a busy machine draws late."""
    for _ in range(60):
        page.wait_for_timeout(250)
        moved = (drawn(page) != first).sum()
        if moved > 20:
            break
    return moved


@pytest.mark.parametrize("kind", ["track", "registration", "spine"])
def test_a_result_opens_and_plays(kind, request, record, pictures):
    if kind == "registration":
        pair = request.getfixturevalue("toy_pair")
        scene = result_scene(request.getfixturevalue("registered_toy"), data=[pair.target.points])
    else:
        scene = track_scene() if kind == "track" else request.getfixturevalue("spine_scene")
    with SceneViewer(scene, port=0) as viewer:
        page = record.page
        page.goto(viewer.url)
        first = wait_until_drawn(page)
        assert 0.005 < first.mean() < 0.9
        page.screenshot(path=pictures / f"view_{kind}.png")
        viewer.show(scene.num_frames - 1)
        assert wait_until_moved(page, first) > 20
        page.get_by_role("button", name="Play").click()
        page.get_by_role("button", name="Pause").wait_for(timeout=10_000)
        page.get_by_role("button", name="Pause").click()
        assert record.problems(viewer.url) == []


def test_one_file_opens_without_a_server(spine_scene, record, tmp_path, pictures):
    scene = spine_scene
    # Long frames: without a graphics card, playing it over and over takes all of the processor.
    path = scene_html(tmp_path / "spine.html", Scene(scene.title, scene.layers, torch.tensor([0.0, 600.0])))
    url = path.as_uri()
    record.page.context.set_offline(True)
    record.page.goto(url)
    # It plays: its picture never stands still.
    assert wait_until_drawn(record.page, still=False).mean() > 0.005
    record.page.screenshot(path=pictures / "file.png")
    assert record.problems(url) == []
