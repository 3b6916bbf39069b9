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
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.tracker import TrackConfig, Tracker
from torchreg.viz.figures import draw_scene, scene_view
from torchreg.viz.posed_scenes import frame_label, near_surface, posed_scene
from torchreg.viz.tracking import FrameOverlays, animate_track, save_track_gltf

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


def spread(pixels):
    """Return how far each pixel's channels are apart: zero for grays."""
    return pixels.max(-1) - pixels.min(-1)


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
    view = scene_view(posed_scene(plain_hand, records[0].pose[None], skin=skin), size=SIZE)

    def draw(pose=records[0].pose, data=frames[0], inliers=records[0].inliers, **options):
        scene = posed_scene(plain_hand, pose[None], [data], [inliers], skin=skin, **options)
        figure = draw_scene(scene, view=view).figure
        figure.canvas.draw()
        return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)

    return draw


def test_a_surface_is_gray_where_no_data_support_it_and_data_are_blue_or_gray(drawing, tracked):
    frames, records, _ = tracked
    nothing, none = frames[0][:0], torch.zeros(0, dtype=torch.bool)
    found, held = drawing(data=nothing, inliers=none), drawing(data=nothing, inliers=none, usable=[False])
    assert (spread(found) > 30).mean() > 0.1
    assert (spread(held) > 30).mean() == 0
    # The same place, another color.
    np.testing.assert_array_equal(found.min(-1) < 250, held.min(-1) < 250)
    blue = [
        pixels[..., 2] - pixels[..., 0] > 60 for pixels in (drawing(), drawing(inliers=~records[0].inliers & False))
    ]
    assert blue[0].sum() > 50
    assert blue[1].sum() == 0
    unknown = drawing(pose=records[0].pose * torch.nan, inliers=torch.zeros_like(records[0].inliers))
    assert (spread(unknown) < 12).all()
    assert (unknown < 200).any()
    # Points that are not finite are left out.
    data, inliers = (
        torch.cat([frames[0], frames[0][:2] * torch.nan]),
        torch.cat([records[0].inliers, torch.ones(2) > 0]),
    )
    np.testing.assert_array_equal(drawing(data=data, inliers=inliers), drawing())


def test_labels_say_what_led_to_a_pose_or_why_there_is_none(drawing):
    assert frame_label(3, Status.CONVERGED, "tracked") == "frame 3: tracked"
    assert frame_label(0, Status.MAX_STEPS, "found") == "frame 0: found"
    assert frame_label(12, Status.NO_DATA, "held") == "frame 12: no_data"
    corner = np.s_[-16:, :60]
    assert np.abs(drawing(captions=["12  lost"])[corner] - drawing()[corner]).max() > 100


def test_overlays_show_each_frame_in_a_view_that_stays_until_the_hand_leaves(plain_hand, skin, tracked, tmp_path):
    frames, records, _ = tracked
    overlays, views = FrameOverlays(plain_hand, skin, size=SIZE), []
    for number, (data, record) in enumerate(zip(frames, records, strict=True)):
        with Image.open(overlays.save(tmp_path / f"{number}.png", data, record)) as file:
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


def test_overlays_of_what_was_never_found_show_the_data(plain_hand, tracked, tmp_path):
    frames, _, _ = tracked
    tracker = Tracker(plain_hand, config=TrackConfig(recovery="none"))
    overlays = FrameOverlays(plain_hand, size=SIZE)
    for number, data in enumerate([frames[2], frames[0]]):
        assert overlays.save(tmp_path / f"{number}.png", data, tracker.step(data)).exists()
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
    near = near_surface(plain_hand, result.poses, 0.004)(0, frames[0][:40])
    expected = [abs(float(plain_hand.distance(point[None], result.poses[0]))) < 0.004 for point in frames[0][:40]]
    assert near.tolist() == expected


def test_frames_are_read_when_they_are_drawn(plain_hand, skin, tracked, tmp_path):
    frames, _, result = tracked
    read = []

    class Files:
        def __len__(self):
            return len(frames)

        def __getitem__(self, number):
            read.append(number)
            return frames[number]

    animate_track(tmp_path / "a.gif", plain_hand, result, Files(), skin=skin, size=SIZE)
    assert read == [0, 1, 2, 3]


def test_a_track_without_a_pose_plays_its_data(plain_hand, skin, tracked, tmp_path):
    frames, _, result = tracked
    lost = replace(
        result, poses=result.poses[:2] * torch.nan, statuses=(Status.LOST,) * 2, acquired=("lost",) * 2,
        times=result.times[:2],
    )  # fmt: skip
    shown = pictures_of(
        animate_track(tmp_path / "a.gif", plain_hand, lost, [frames[2], frames[0]], skin=skin, size=SIZE)
    )
    assert (spread(np.stack(shown)) < 12).all()
    with pytest.raises(InputError, match="the shape was never found"):
        save_track_gltf(tmp_path / "a.glb", plain_hand, lost, skin=skin)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": slice(3)}, r"result\.poses must have shape \(3, 27\), got \(4, 27\)"),
        ({"inliers": [torch.ones(3) > 0]}, r"inliers must hold one entry per pose \(4\), got 1"),
        ({"inliers": [torch.ones(3) > 0] * 4}, "inliers must have shape"),
        ({"inliers": [torch.ones(300)] * 4}, "inliers must"),
        ({"frames": slice(0), "poses": slice(0)}, "frames must hold at least one cloud"),
        ({"inlier_distance": 0.0}, "inlier_distance must be positive"),
        ({"path": "a.png"}, "path must end in"),
    ],
)
def test_animate_track_refuses(plain_hand, skin, tracked, tmp_path, options, message):
    frames, _, result = tracked
    options = {"frames": slice(None), "poses": slice(None), "path": "a.gif", "skin": skin, **options}
    frames, result = frames[options.pop("frames")], replace(result, poses=result.poses[options.pop("poses")])
    with pytest.raises(InputError, match=message):
        animate_track(tmp_path / options.pop("path"), plain_hand, result, frames, **options)
    assert list(tmp_path.iterdir()) == []


def test_the_moving_shape_begins_where_it_was_found(gltf_viewer, plain_hand, skin, tracked, tmp_path):
    _, _, result = tracked
    poses = result.poses.clone()
    poses[0] = torch.nan
    late = replace(result, poses=poses, times=result.times / 20 - 3)
    viewer = gltf_viewer(save_track_gltf(tmp_path / "a.glb", plain_hand, late, skin=skin))
    seconds = viewer.read(viewer.gltf.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(seconds, [0.05, 0.1, 0.15], atol=1e-6)
    np.testing.assert_allclose(viewer.vertices(0), skin(poses[1]).detach(), atol=1e-5)
    bare = LinearBlendSkin(plain_hand, skin.points, skin.weights, skin.reference_pose)
    with pytest.raises(InputError, match="skin must have faces"):
        save_track_gltf(tmp_path / "b.glb", plain_hand, late, skin=bare)
