import os
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.datasets.sequences import range_clouds
from torchreg.errors import InputError, MissingExtraError
from torchreg.shapes.hand import Hand
from torchreg.viz.animation import animate_alignment, save_animation


@pytest.fixture(scope="module")
def hand():
    return Hand()


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.007)


@pytest.fixture(scope="module")
def clouds(hand, skin):
    poses = hand_motion(hand, "bend", 4, 5.0)
    return range_clouds(hand, poses, skin=skin, num_points=200, camera=torch.zeros(3))


def frames_of(path):
    with Image.open(path) as file:
        pictures = []
        for index in range(file.n_frames):
            file.seek(index)
            pictures.append((np.asarray(file.convert("RGB")), file.info["duration"]))
        return pictures, file.info.get("loop")


def plain(color, size=(30, 40)):
    return np.full((*size, 3), color, dtype=np.uint8)


def test_arrays_tensors_and_functions_become_frames(tmp_path):
    told = []
    frames = [plain((255, 0, 0)), torch.zeros(30, 40, 3), lambda ax: ax.fill([0, 1, 1, 0], [0, 0, 1, 1], color="lime")]
    path = save_animation(
        tmp_path / "a.gif", frames, 10, size=(40, 30), on_frame=lambda done, total: told.append((done, total))
    )
    pictures, loop = frames_of(path)
    assert [picture.shape for picture, _ in pictures] == [(30, 40, 3)] * 3
    assert [duration for _, duration in pictures] == [100] * 3
    assert loop == 0
    np.testing.assert_array_equal(pictures[0][0], plain((255, 0, 0)))
    np.testing.assert_array_equal(pictures[1][0], plain((0, 0, 0)))
    np.testing.assert_allclose(pictures[2][0][15, 20], (0, 255, 0), atol=5)
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_colors_keep_their_tone(tmp_path):
    ramp = np.linspace(0, 1, 64)[None, :, None].repeat(8, 0).repeat(3, 2)
    (picture, _) = frames_of(save_animation(tmp_path / "a.gif", [ramp, 1 - ramp]))[0][0]
    assert np.abs(picture / 255 - ramp).max() < 0.03


def test_an_interruption_leaves_the_frames_so_far(tmp_path):
    def stop(done, _):
        if done == 2:
            raise KeyboardInterrupt

    frames = [plain((20 * index, 0, 0)) for index in range(1, 6)]
    with pytest.raises(KeyboardInterrupt):
        save_animation(tmp_path / "a.gif", frames, on_frame=stop)
    assert len(frames_of(tmp_path / "a.gif")[0]) == 2


def test_an_interruption_before_the_first_frame_leaves_no_file(tmp_path):
    def interrupt(ax):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_animation(tmp_path / "a.gif", [interrupt])
    assert list(tmp_path.iterdir()) == []


def test_a_failing_frame_leaves_no_file(tmp_path):
    with pytest.raises(InputError, match=r"frames\[1\] must be \(30, 40, 3\) like frames\[0\], got \(9, 9, 3\)"):
        save_animation(tmp_path / "a.gif", [plain(0), plain(0, (9, 9))])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("frames", "name", "fps", "error", "message"),
    [
        ([], "a.gif", 20, InputError, "frames must hold at least one frame"),
        ([plain(0)], "a.avi", 20, InputError, r"path must end in \.gif or \.mp4, got 'a\.avi'"),
        ([plain(0)], "none/a.gif", 20, FileNotFoundError, "does not exist"),
        ([plain(0)], "a.gif", 0.0, InputError, "fps must be positive"),
        ([np.zeros((4, 4))], "a.gif", 20, InputError, r"frames\[0\] must have shape \(H, W, 3\)"),
        ([np.full((4, 4, 3), 7.0)], "a.gif", 20, InputError, r"frames\[0\] must be uint8 or lie in \[0, 1\]"),
        ([np.full((4, 4, 3), np.nan)], "a.gif", 20, InputError, r"frames\[0\] must be uint8 or lie in \[0, 1\]"),
    ],
)
def test_save_animation_refuses(tmp_path, frames, name, fps, error, message):
    with pytest.raises(error, match=message):
        save_animation(tmp_path / name, frames, fps)


@pytest.fixture
def encoder(tmp_path, monkeypatch):
    """Put a stand-in for ffmpeg, which keeps what it is given, on the path; return the function that makes it."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)

    def make(code):
        program = folder / "ffmpeg"
        program.write_text(f"#!{sys.executable}\nimport sys\nraw = sys.stdin.buffer.read()\n{code}\n", encoding="utf-8")
        program.chmod(0o755)

    make("open(sys.argv[-1], 'wb').write(' '.join(sys.argv).encode() + b'|' + raw)")
    return make


@pytest.mark.skipif(os.name != "posix", reason="the stand-in is a script")
def test_mp4_is_encoded_by_ffmpeg(tmp_path, encoder):
    frames = [plain((255, 0, 0)), plain((0, 90, 255))]
    path = save_animation(tmp_path / "a.mp4", frames, 12.5)
    command, _, raw = path.read_bytes().partition(b"|")
    options = command.decode().split()
    assert options[options.index("-s") + 1] == "40x30"
    assert options[options.index("-framerate") + 1] == "12.5"
    assert "h264" in options
    given = np.frombuffer(raw, dtype=np.uint8).reshape(2, 30, 40, 4)[..., :3]
    # Without the few tones of a GIF.
    np.testing.assert_array_equal(given, np.stack(frames))


@pytest.mark.skipif(os.name != "posix", reason="the stand-in is a script")
def test_an_encoder_that_fails_is_told_and_an_interrupted_one_leaves_what_is_drawn(tmp_path, encoder):
    def stop(done, _):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_animation(tmp_path / "a.mp4", [plain(0)] * 5, on_frame=stop)
    assert len((tmp_path / "a.mp4").read_bytes().partition(b"|")[2]) == 2 * 30 * 40 * 4
    encoder("print('Unknown encoder', file=sys.stderr); sys.exit(3)")
    with pytest.raises(OSError, match=r"b\.mp4: ffmpeg failed \(Unknown encoder\); write a \.gif"):
        save_animation(tmp_path / "b.mp4", [plain(0)])
    with pytest.raises(InputError, match=r"frames\[1\]"):
        save_animation(tmp_path / "b.mp4", [plain(0), plain(0, (9, 9))])
    assert not (tmp_path / "b.mp4").exists()


def test_mp4_needs_ffmpeg(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"a\.mp4 needs the program ffmpeg"):
        save_animation(tmp_path / "a.mp4", [plain(0)])


def test_an_alignment_plays_in_a_small_file(hand, skin, clouds, tmp_path):
    poses = torch.stack([cloud.pose for cloud in clouds])
    path = animate_alignment(
        tmp_path / "a.gif",
        hand,
        poses,
        [cloud.points for cloud in clouds],
        inliers=[cloud.inliers for cloud in clouds],
        skin=skin,
    )
    assert path.stat().st_size / len(clouds) < 1.5e6 / 40
    pictures, _ = frames_of(path)
    assert [picture.shape for picture, _ in pictures] == [(360, 360, 3)] * 4
    assert pictures[0][1] == 50
    assert np.abs(pictures[0][0].astype(int) - pictures[2][0]).mean() > 1


def test_a_coarse_surface_and_all_points_by_default(hand, clouds, tmp_path):
    told = []
    path = animate_alignment(
        tmp_path / "a.gif",
        hand,
        clouds[0].pose[None],
        [clouds[0].points],
        camera=torch.tensor([0.1, -0.1, 0.0]),
        size=(60, 50),
        on_frame=lambda done, total: told.append((done, total)),
    )
    assert frames_of(path)[0][0][0].shape == (50, 60, 3)
    assert told == [(1, 1)]


def test_animate_alignment_refuses(hand, skin, clouds, tmp_path):
    path, points = tmp_path / "a.gif", [clouds[0].points]
    pose = hand.rest_pose()[None]
    with pytest.raises(InputError, match=r"poses must have shape \(1, 27\), got \(2, 27\)"):
        animate_alignment(path, hand, pose.expand(2, -1), points, skin=skin)
    with pytest.raises(InputError, match=r"inliers must hold one mask per cloud \(1\), got 0"):
        animate_alignment(path, hand, pose, points, inliers=[], skin=skin)
    with pytest.raises(InputError, match="clouds must hold at least one cloud"):
        animate_alignment(path, hand, pose[:0], [], skin=skin)
    with pytest.raises(InputError, match="path must end in"):
        animate_alignment(tmp_path / "a.avi", hand, pose, points, skin=skin)
