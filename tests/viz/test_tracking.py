"""Pictures of tracked sequences: found, held and unknown poses, views that follow, moving pictures and scenes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.datasets.sequences import range_clouds
from torchreg.errors import InputError
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.tracker import TrackConfig, Tracker
from torchreg.viz import tracking
from torchreg.viz.figures import new_figure, watch
from torchreg.viz.tracking import FrameOverlays, animate_track, draw_track_frame, frame_label, save_track_gltf

SIZE = (90, 80)


@pytest.fixture(scope="module")
def skin(plain_hand):
    return surface_skin(plain_hand, spacing=0.008)


@pytest.fixture(scope="module")
def tracked(plain_hand, plain_hand_skin, skin):
    """Frames, records and the result of a hand that is there, gone for a frame, and there again."""
    poses = hand_motion(plain_hand, "bending_palm", 4, seed=2)
    clouds = range_clouds(plain_hand, poses, num_points=300, outlier_ratio=0.3, camera=torch.zeros(3), skin=skin)
    frames, records = [cloud.points for cloud in clouds], []
    frames[2] = frames[2][:0]
    tracker = Tracker(plain_hand, poses[0], model_points=plain_hand_skin)
    return frames, records, tracker.run(frames, lambda points, record: records.append(record))


def picture(draw, size=SIZE):
    figure, (ax,) = new_figure(*size)
    draw(ax)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def spread(pixels):
    """Return how far each pixel's channels are apart: zero for grays."""
    return pixels.max(-1) - pixels.min(-1)


def blueness(pixels):
    return pixels[..., 2] - pixels[..., 0]


def pictures_of(path):
    with Image.open(path) as file:
        frames = []
        for index in range(file.n_frames):
            file.seek(index)
            frames.append(np.asarray(file.convert("RGB")).astype(int))
        return frames


@pytest.fixture
def drawing(plain_hand, skin, tracked):
    """Return the function that draws the first frame, with other arguments."""
    frames, records, _ = tracked
    view = watch(skin(records[0].pose), size=SIZE)

    def draw(pose=records[0].pose, data=frames[0], inliers=records[0].inliers, **options):
        return picture(
            lambda ax: draw_track_frame(ax, plain_hand, pose, data, inliers, skin=skin, view=view, **options)
        )

    return draw


def test_a_surface_is_gray_where_no_data_support_it(drawing, tracked):
    nothing = tracked[0][0][:0]
    found = drawing(data=nothing, inliers=torch.zeros(0, dtype=torch.bool))
    held = drawing(data=nothing, inliers=torch.zeros(0, dtype=torch.bool), predicted=True)
    assert (spread(found) > 30).mean() > 0.1
    assert (spread(held) > 30).mean() == 0
    # The same place, another color.
    np.testing.assert_array_equal(found.min(-1) < 250, held.min(-1) < 250)


def test_inliers_are_blue_and_without_a_pose_all_data_are_gray(drawing, tracked):
    _, records, _ = tracked
    blue = (blueness(drawing()) > 60).sum()
    assert blue > 50
    assert (blueness(drawing(inliers=torch.zeros_like(records[0].inliers))) > 60).sum() == 0
    unknown = drawing(pose=records[0].pose * torch.nan)
    assert (spread(unknown) < 12).all()
    assert (unknown < 200).any()


def test_points_that_are_not_finite_are_left_out(drawing, tracked):
    frames, records, _ = tracked
    data = torch.cat([frames[0], frames[0][:2] * torch.nan])
    inliers = torch.cat([records[0].inliers, torch.ones(2, dtype=torch.bool)])
    np.testing.assert_array_equal(drawing(data=data, inliers=inliers), drawing())
    with pytest.raises(InputError, match="inliers must have shape"):
        drawing(inliers=records[0].inliers[:-1])


def test_labels_say_what_led_to_a_pose_or_why_there_is_none(drawing):
    assert frame_label(3, Status.CONVERGED, "tracked") == "frame 3: tracked"
    assert frame_label(0, Status.MAX_STEPS, "found") == "frame 0: found"
    assert frame_label(12, Status.NO_DATA, "held") == "frame 12: no_data"
    corner = np.s_[-16:, :60]
    assert np.abs(drawing(label="12  lost")[corner] - drawing()[corner]).max() > 100


def test_overlays_show_each_frame_in_a_view_that_stays_until_the_hand_leaves(plain_hand, skin, tracked, tmp_path):
    frames, records, _ = tracked
    overlays = FrameOverlays(plain_hand, skin, size=SIZE)
    views = []
    for number, (data, record) in enumerate(zip(frames, records, strict=True)):
        path = overlays.save(tmp_path / f"{number}.png", data, record)
        with Image.open(path) as file:
            assert file.size == SIZE
        views.append(overlays._view)
    assert all(view is views[0] for view in views)
    gone = records[0].pose.clone()
    gone[0] += 0.3
    overlays.save(tmp_path / "gone.png", frames[0] + torch.tensor([0.3, 0.0, 0.0]), replace(records[0], pose=gone))
    pixels, _ = overlays._view.project(skin(gone))
    assert overlays._view is not views[0]
    assert (pixels >= 0).all()
    assert (pixels <= pixels.new_tensor([2 * SIZE[0], 2 * SIZE[1]])).all()


def test_overlays_of_what_was_never_found_show_the_data(plain_hand, skin, tracked, tmp_path):
    frames, _, _ = tracked
    tracker = Tracker(plain_hand, config=TrackConfig(recovery="none"))
    overlays = FrameOverlays(plain_hand, skin, size=SIZE)
    for number, data in enumerate([frames[2], frames[0]]):
        path = overlays.save(tmp_path / f"{number}.png", data, tracker.step(data))
        assert path.exists()
    pixels, _ = overlays._view.project(frames[0])
    assert (pixels >= 0).all()


def test_a_track_plays_with_the_inliers_of_the_tracker(plain_hand, plain_hand_skin, skin, tracked, tmp_path):
    frames, records, result = tracked
    told = []
    given = animate_track(
        tmp_path / "given.gif", plain_hand, result, frames, inliers=[record.inliers for record in records], fps=10,
        skin=skin, size=SIZE, on_frame=lambda done, planned: told.append((done, planned)),
    )  # fmt: skip
    size = float((plain_hand_skin.points.amax(0) - plain_hand_skin.points.amin(0)).norm())
    computed = animate_track(
        tmp_path / "computed.gif", plain_hand, result, frames, inlier_distance=0.02 * size, skin=skin, size=SIZE
    )
    assert told == [(k, 4) for k in (1, 2, 3, 4)]
    for one, other in zip(pictures_of(given), pictures_of(computed), strict=True):
        assert one.shape == (SIZE[1], SIZE[0], 3)
        np.testing.assert_array_equal(one, other)
    surface = [(spread(frame) > 30).mean() for frame in pictures_of(given)]
    # The third frame has no data: its pose is a guess.
    assert surface[2] < 0.02 < 0.1 < min(surface[0], surface[1], surface[3])


def test_distances_decide_about_inliers_and_other_numbers_do_not_count(plain_hand, tracked, monkeypatch):
    frames, records, _ = tracked
    data = torch.cat([frames[0], frames[0][:1] * torch.nan])
    near = tracking._near(plain_hand, records[0].pose, data, 0.004)
    expected = [bool(abs(float(plain_hand.distance(point[None], records[0].pose))) < 0.004) for point in frames[0][:40]]
    assert near[:40].tolist() == expected
    assert not near[-1]
    assert not tracking._near(plain_hand, records[0].pose * torch.nan, data, 0.004).any()


def test_a_track_without_a_pose_plays_its_data(plain_hand, skin, tracked, tmp_path):
    frames, _, result = tracked
    lost = replace(result, poses=result.poses * torch.nan, statuses=(Status.LOST,) * 4)
    order = [frames[2], frames[0]]
    lost = replace(lost, poses=lost.poses[:2], statuses=lost.statuses[:2])
    shown = pictures_of(animate_track(tmp_path / "a.gif", plain_hand, lost, order, skin=skin, size=SIZE))
    assert (spread(np.stack(shown)) < 12).all()
    with pytest.raises(InputError, match="the shape was never found"):
        save_track_gltf(tmp_path / "a.glb", plain_hand, lost, skin=skin)


def test_a_default_surface_is_made(plain_hand, tracked, tmp_path, monkeypatch):
    frames, records, result = tracked
    one = replace(result, poses=result.poses[:1], statuses=result.statuses[:1], acquired=result.acquired[:1])
    assert len(pictures_of(animate_track(tmp_path / "a.gif", plain_hand, one, frames[:1], size=SIZE))) == 1
    FrameOverlays(plain_hand, size=SIZE).save(tmp_path / "a.png", frames[0], records[0])


def test_animate_track_refuses(plain_hand, skin, tracked, tmp_path):
    frames, _, result = tracked
    path = tmp_path / "a.gif"
    with pytest.raises(InputError, match=r"result\.poses must have shape \(3, 27\), got \(4, 27\)"):
        animate_track(path, plain_hand, result, frames[:3], skin=skin)
    with pytest.raises(InputError, match=r"inliers must hold one mask per frame \(4\), got 1"):
        animate_track(path, plain_hand, result, frames, inliers=[frames[0]], skin=skin)
    with pytest.raises(InputError, match="frames must hold at least one cloud"):
        animate_track(path, plain_hand, replace(result, poses=result.poses[:0]), [], skin=skin)
    with pytest.raises(InputError, match="inlier_distance must be positive"):
        animate_track(path, plain_hand, result, frames, inlier_distance=0.0, skin=skin)
    with pytest.raises(InputError, match="path must end in"):
        animate_track(tmp_path / "a.png", plain_hand, result, frames, skin=skin)
    assert list(tmp_path.iterdir()) == []


def test_the_moving_shape_begins_where_it_was_found(plain_hand, skin, tracked, tmp_path, monkeypatch):
    _, _, result = tracked
    poses = result.poses.clone()
    poses[0] = torch.nan
    late = replace(result, poses=poses, times=result.times / 20 - 3)
    calls = []
    original = tracking.save_shape_animation

    def noted(path, shape, poses, times, **options):
        calls.append((poses, times))
        return original(path, shape, poses, times, **options)

    monkeypatch.setattr(tracking, "save_shape_animation", noted)
    path = save_track_gltf(tmp_path / "a.glb", plain_hand, late, skin=skin)
    assert set(ArticulatedShape.from_gltf(path).part_names) == set(plain_hand.part_names)
    ((moved, times),) = calls
    assert torch.equal(moved, result.poses[1:])
    assert times.tolist() == pytest.approx([0.05, 0.1, 0.15])
    bare = LinearBlendSkin(plain_hand, skin.points, skin.weights, skin.reference_pose)
    with pytest.raises(InputError, match="skin must have faces"):
        save_track_gltf(path, plain_hand, late, skin=bare)
