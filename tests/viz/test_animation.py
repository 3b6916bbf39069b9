import os
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.errors import InputError, MissingExtraError
from torchreg.geometry.mesh import unit_sphere
from torchreg.viz.animation import animate_scene, save_animation
from torchreg.viz.scene import MovingMesh, Scene


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


def test_a_scene_plays_in_one_view(tmp_path):
    ball, told = unit_sphere(1), []
    moving = torch.stack([ball.vertices + torch.tensor([shift, 0, 0]) for shift in (0.0, 3.0, torch.nan)])
    scene = Scene("", (MovingMesh("ball", moving, ball.faces, (1.0, 0.0, 0.0)),), captions=("0", "1", "2"))
    path = animate_scene(tmp_path / "a.gif", scene, 10, size=(90, 60), on_frame=lambda *n: told.append(n))
    pictures = [picture.astype(int) for picture, _ in frames_of(path)[0]]
    assert [picture.shape for picture in pictures] == [(60, 90, 3)] * 3
    assert told == [(1, 3), (2, 3), (3, 3)]
    red = [picture[..., 0] - picture[..., 1] > 60 for picture in pictures]
    across, down = [np.nonzero(mask)[1].mean() for mask in red[:2]], [mask.sum() for mask in red]
    assert abs(across[0] - across[1]) > 10
    assert down[1] > 0.5 * down[0] > 0
    assert down[2] == 0  # the shape was not found
    with pytest.raises(InputError, match="path must end in"):
        animate_scene(tmp_path / "a.avi", scene)
