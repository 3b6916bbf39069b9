"""Pictures and movies: surfaces are lit and opaque where they are, points and curves lie where the camera sees them."""

import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import torchreg as tr
from tests.tables import each_row, refused, refusing
from torchreg.viz import animation, figures, spines, tracking
from torchreg.viz import scene as sc
from torchreg.viz.result_scenes import result_scene

InputError = tr.errors.InputError
Cloud, Curves, MovingMesh, Scene = sc.Cloud, sc.Curves, sc.MovingMesh, sc.Scene
SIZE = (90, 80)


@pytest.fixture(scope="module")
def ball(tools):
    return tools.ball(3)


@pytest.fixture(scope="module")
def render(ball):
    """Return the function that renders a mesh, the ball by default, as seen along z from above."""
    above = {"camera": torch.tensor([0.0, 0.0, 8.0]), "up": torch.tensor([0.0, 1.0, 0.0])}
    view = figures.watch(ball.vertices, size=(60, 60), margin=0.0, **above)

    def render(mesh=ball, *paint):
        return figures.render_mesh(mesh, view, *paint)

    return render


def pixels(ax):
    ax.figure.canvas.draw()
    return np.asarray(ax.figure.canvas.buffer_rgba())[..., :3].astype(int)


def spread(drawn):
    """Return how far each pixel's channels are apart: zero for grays."""
    return drawn.max(-1) - drawn.min(-1)


def png_size(path):
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        return picture.size


def test_a_sphere_is_lit_from_the_upper_left_and_transparent_around(ball, render):
    picture = render()
    assert picture.shape == (60, 60, 4)
    opacity, brightness = picture[..., 3], picture[..., :3].mean(-1)
    radius = math.sqrt(float(opacity.sum()) / math.pi)
    columns = opacity[30].sum()
    assert float(columns) == pytest.approx(2 * radius, rel=0.03)
    assert 25 < radius <= 30.5
    assert float(opacity[0, 0]) == 0
    assert brightness[18, 20] > brightness[42, 40] + 0.1
    assert 0 <= float(picture.min()) <= float(picture.max()) <= 1
    # Scans whose triangles face away look the same.
    torch.testing.assert_close(render(tr.TriangleMesh(ball.vertices, ball.faces[:, [0, 2, 1]])), picture)
    assert float(render(tr.TriangleMesh(ball.vertices + torch.tensor([50.0, 0, 0]), ball.faces)).abs().max()) == 0
    # An outline is not stained by the background.
    white = render(ball, torch.ones(642, 3))
    faint = (white[..., 3] > 0.2) & (white[..., 3] < 0.8)
    assert bool(faint.any())
    assert float(white[faint][:, :3].min()) > 0.15
    red = torch.tensor([1.0, 0, 0])
    for paint in (red.expand(642, 3), (1.0, 0.0, 0.0), lambda face, share: red.expand(len(face), 3)):
        shown = render(ball, paint)[30, 30]
        assert shown[0] > 3 * shown[1]


def test_deeper_surfaces_are_darker(render):
    square, faces = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    plates = [torch.cat([half * square, torch.full((4, 1), z)], 1) for z, half in ((-1.0, 1.0), (0.0, 0.3))]
    picture = render(tr.TriangleMesh(torch.cat(plates), torch.cat([faces, faces + 4])))[..., 0]
    beside = int((picture[30, 30:] < picture[30, 30] - 0.02).nonzero()[0]) + 30
    assert picture[30, beside] < picture[30, beside + 12] - 0.01


def test_cameras_watch_measurements_from_the_origin_and_objects_from_in_front(ball):
    measured = figures.watch(0.1 * ball.vertices + torch.tensor([0.0, 0.0, 0.6]))
    assert measured.rotation[2, 2] > 0.8
    assert measured.rotation[1, 1] > 0.8
    assert figures.watch(ball.vertices).rotation[1, 2] < -0.8
    given = {"camera": torch.tensor([0.0, 0.0, 9.0]), "up": torch.tensor([1.0, 0, 0]), "size": (30, 20)}
    chosen = figures.watch(ball.vertices, **given)
    assert (chosen.width, chosen.height) == (60, 40)
    torch.testing.assert_close(chosen.rotation[1], torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))


def test_layers_are_drawn_upright_in_their_colors_on_given_axes(ball):
    red = MovingMesh("low", ball.vertices, ball.faces, (1.0, 0.0, 0.0))
    blue = MovingMesh("high", ball.vertices + torch.tensor([0.0, 3.0, 0.0]), ball.faces, (0.0, 0.0, 1.0))
    scene = Scene("two balls", (red, blue), up=(0.0, 1.0, 0.0), captions=("a caption",))
    ax = figures.draw_scene(scene)
    drawn = pixels(ax)
    rows = [np.nonzero((drawn[..., one] - drawn[..., other]) > 60)[0].mean() for one, other in ((0, 2), (2, 0))]
    assert rows[1] < rows[0]
    assert ax.get_title() == "two balls"
    assert [text.get_text() for text in ax.texts] == ["a caption"]
    assert not ax.axison
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()
    _, axes = figures.new_figure(100, 40, 2)
    assert figures.draw_scene(scene, ax=axes[1], size=(50, 40)) is axes[1]
    assert (axes[1].get_xlim(), axes[1].get_ylim()) == ((0, 100), (80, 0))


def test_points_lie_where_the_camera_sees_them_and_are_pale_behind_a_surface(ball):
    places = torch.tensor([[0.0, 0, 1.1], [0.0, 0, -1.1], [1.2, 0, 0], [0, 0, 50.0]])
    line = torch.tensor([[[0.0, 0, 1.2], [1.0, 1, 1]]])
    layers = (
        MovingMesh("ball", ball.vertices, ball.faces), Cloud("data", [places], [torch.eye(4, 3)]),
        Curves("line", line, torch.tensor([[0.2, 0.4, 0.6]]), labels=("tip",)),
        Cloud("hidden", [places], (0.0, 0.0, 0.0), visible=False),
    )  # fmt: skip
    scene = Scene("ball", layers)
    view = figures.scene_view(scene, camera=torch.tensor([0.0, 0, 8]), size=(60, 60))
    ax = figures.draw_scene(scene, view=view)
    (dots,) = ax.collections
    order = [1, 0, 2]  # those in front last; the one behind the camera not at all
    np.testing.assert_allclose(dots.get_offsets(), view.project(places.double())[0][order], atol=1e-3)
    np.testing.assert_allclose(dots.get_facecolor()[:, :3], torch.eye(4, 3)[order])
    assert dots.get_facecolor()[0, 3] < 0.5
    assert dots.get_facecolor()[1:, 3].tolist() == [1, 1]
    np.testing.assert_allclose(ax.lines[0].get_xydata(), view.project(line[0])[0], atol=1e-3)


def test_every_kind_of_result_has_a_picture(
    registration, sequence, spine, starts, hand, alignment, clouds, track, ball
):
    for result, options in ((registration, {}), (sequence, {}), (spine, {}), (starts, {"shape": hand, "frame": 0})):
        assert float((pixels(tr.plot(result, **options)) < 250).any(-1).mean()) > 0.003
    assert "degrees of freedom" in tr.plot(hand).get_title()
    assert tr.plot(torch.rand(50, 3)).get_title() == "50 points"
    assert len(alignment.plot(clouds[0], shape=hand).collections) == 1
    ends = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 0.9, 0], [0, 0, 0.9]])
    ax = tr.plot(tr.Skeleton(ends, [[0, 1], [0, 2], [0, 3]], torch.ones(4)), ball)
    palette = spines.bone_palette(3).tolist()
    assert [line.get_color() for line in ax.lines if len(line.get_xdata()) > 1] == palette
    assert len(ax.images) == 1
    with pytest.raises(InputError, match="frame must be from 0 to 2, got 3"):
        tr.plot(track, shape=hand, frame=3)
    with pytest.raises(tr.errors.InputTypeError, match="must be one that can be shown"):
        tr.plot("hand")


def test_pictures_of_the_documentation_show_a_finger_per_sharpness(tmp_path):
    path = figures.bending_picture(tmp_path / "bend.png", (2.0, 10.0))
    assert png_size(path) == (800, 400)
    assert png_size(figures.readme_picture(tmp_path / "readme.png")) == (1200, 400)
    assert max(file.stat().st_size for file in tmp_path.iterdir()) < 200_000
    finger = figures._finger()
    mesh = finger.surface_mesh(spacing=0.003)
    weights = [tr.BendingSkin(finger, mesh.vertices, sharpness=a).weights for a in (2.0, 10.0)]
    # A dull skin stretches over a wider bend than a sharp one.
    dull, sharp = (float(((each > 0.05) & (each < 0.95)).any(-1).float().mean()) for each in weights)
    assert dull > 2 * sharp > 0
    figure, _ = figures.new_figure(20, 20)
    assert png_size(figures.save_picture(figure, tmp_path / "a.png", dpi=200)) == (40, 40)
    refused(
        (lambda: figures.bending_picture(path, ()), "sharpness must hold at least one"),
        (lambda: figures.bending_picture(path, (-1.0,)), "sharpness must be positive"),
        (lambda: figures.save_picture(figure, tmp_path / "a.x"), r"\.pdf or \.svg, got 'a\.x'"),
        error=InputError,
    )
    refused((lambda: figures.save_picture(figure, tmp_path / "none/a.png"), "does not exist"), error=FileNotFoundError)


@pytest.mark.parametrize("frames", [1, 3])
def test_measurements_are_drawn_over_time_in_the_colors_of_limbs(spine, frames):
    curves = torch.eye(3)[:, None] * torch.linspace(0.9, 0, 8)[:, None]
    curves = curves * torch.linspace(1, 2, frames)[:, None, None, None]
    times = torch.linspace(0, 1, frames)
    model = tr.Spine(curves, spine.graph, torch.ones(frames, 3, 8))
    found = replace(spine, model=model, curves=curves, radii=torch.ones(frames, 3, 8), times=times).measurements()
    lengths, _, angles = spines.draw_measurements(found).axes
    assert [line.get_color() for line in lengths.lines] == spines.bone_palette(3).tolist()
    for limb, line in enumerate(lengths.lines):
        np.testing.assert_allclose(line.get_xydata(), torch.stack((times, found.lengths[:, limb]), dim=1))
    # Both limbs of each of three pairs at right angles.
    assert len(angles.lines) == 6
    np.testing.assert_allclose(angles.lines[0].get_ydata(), 90, atol=1e-4)
    assert [text.get_text() for text in lengths.get_legend().get_texts()] == ["0", "1", "2"]


def test_limbs_keep_colors_and_numbers_and_transferred_ones_are_dashed(spine, ball):
    own = torch.tensor([[True, True, True], [True, False, True], [True, True, True]])
    scene = result_scene(replace(spine, own=own), data=[ball] * 3)
    view = figures.scene_view(scene, size=(80, 60))
    for frame in range(2):
        ax = figures.draw_scene(scene, frame, view=view)
        limbs = [line for line in ax.lines if len(line.get_xdata()) == 8]
        assert [line.get_linestyle() for line in limbs] == ["-" if solid else "--" for solid in own[frame].tolist()]
        assert [line.get_color() for line in limbs] == spines.bone_palette(3).tolist()
        for line, curve in zip(limbs, spine.curves[frame], strict=True):
            np.testing.assert_allclose(line.get_xydata(), view.project(curve)[0], atol=1e-3)
        assert [text.get_text() for text in ax.texts] == ["0", "1", "2"]
        assert ax.images[0].get_array()[..., 3].max() < 0.6  # the surface is translucent


def test_spines_have_one_picture_per_frame_and_a_movie(tools, spine, ball, tmp_path):
    meshes, calls = [ball] * 3, []
    view = figures.scene_view(result_scene(spine, data=meshes), size=(80, 60))
    options = {"view": view, "on_frame": lambda *n: calls.append(n)}
    paths = spines.save_spine_pictures(tmp_path / "a", spine, meshes, **options)
    assert [path.name for path in paths] == [f"frame_000{k}.png" for k in range(3)]
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert png_size(paths[0]) == png_size(paths[2]) == (80, 60)
    assert paths[0].read_bytes() != paths[2].read_bytes()
    assert len(tools.pictures_of(spines.save_spine_movie(tmp_path / "a.gif", spine, meshes, view=view))[0]) == 3
    for few in ([ball], []):
        with pytest.raises(InputError, match=r"one surface per frame \(3\)"):
            spines.save_spine_movie(tmp_path / "b.gif", spine, few)


def plain(color, size=(30, 40)):
    return np.full((*size, 3), color, dtype=np.uint8)


def test_arrays_tensors_and_functions_become_frames(tools, tmp_path):
    calls = []
    frames = [plain((255, 0, 0)), torch.zeros(30, 40, 3), lambda ax: ax.fill([0, 1, 1, 0], [0, 0, 1, 1], color="lime")]
    options = {"size": (40, 30), "on_frame": lambda *n: calls.append(n)}
    pictures, info = tools.pictures_of(animation.save_animation(tmp_path / "a.gif", frames, 10, **options))
    assert (info["duration"], info["loop"]) == (100, 0)
    np.testing.assert_array_equal(pictures[:2], [plain((255, 0, 0)), plain(0)])
    np.testing.assert_allclose(pictures[2][15, 20], (0, 255, 0), atol=5)
    assert calls == [(1, 3), (2, 3), (3, 3)]
    ramp = np.linspace(0, 1, 64)[None, :, None].repeat(8, 0).repeat(3, 2)
    pictures, _ = tools.pictures_of(animation.save_animation(tmp_path / "b.gif", [ramp, 1 - ramp]))
    assert np.abs(pictures[0] / 255 - ramp).max() < 0.03  # colors keep their tone


def stop_at_two(done, _):
    if done == 2:
        raise KeyboardInterrupt


def interrupt(ax):
    raise KeyboardInterrupt


def test_an_interruption_leaves_the_frames_so_far_and_a_failing_frame_no_file(tools, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        animation.save_animation(tmp_path / "a.gif", [plain(20 * k) for k in range(1, 6)], on_frame=stop_at_two)
    assert len(tools.pictures_of(tmp_path / "a.gif")[0]) == 2
    with pytest.raises(KeyboardInterrupt):
        animation.save_animation(tmp_path / "b.gif", [interrupt])
    with pytest.raises(InputError, match=r"frames\[1\] must be \(30, 40, 3\) like frames\[0\], got \(9, 9, 3\)"):
        animation.save_animation(tmp_path / "c.gif", [plain(0), plain(0, (9, 9))])
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


test_animations_that_are_refused = refusing(
    lambda folder, frames, name, fps: animation.save_animation(folder / name, frames, fps),
    (InputError, FileNotFoundError),
)(
    ([], "a.gif", 20, "frames must hold at least one frame"),
    ([plain(0)], "a.avi", 20, r"path must end in \.gif or \.mp4, got 'a\.avi'"),
    ([plain(0)], "none/a.gif", 20, "does not exist"),
    ([plain(0)], "a.gif", 0.0, "fps must be positive"),
    ([np.zeros((4, 4))], "a.gif", 20, r"frames\[0\] must have shape \(H, W, 3\)"),
    ([np.full((4, 4, 3), 7.0)], "a.gif", 20, r"frames\[0\] must be uint8 or lie in \[0, 1\]"),
    ([np.full((4, 4, 3), np.nan)], "a.gif", 20, r"frames\[0\] must be uint8 or lie in \[0, 1\]"),
)


@pytest.fixture
def encoder(tmp_path, monkeypatch):
    """Put a stand-in for ffmpeg, which keeps what it is given, on the path; return the function that makes it."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)

    def make(code):
        program = tmp_path / "bin" / "ffmpeg"
        program.write_text(f"#!{sys.executable}\nimport sys\nraw = sys.stdin.buffer.read()\n{code}\n", encoding="utf-8")
        program.chmod(0o755)

    make("open(sys.argv[-1], 'wb').write(' '.join(sys.argv).encode() + b'|' + raw)")
    return make


@pytest.mark.skipif(os.name != "posix", reason="the stand-in is a script")
def test_mp4_is_encoded_by_ffmpeg_whose_errors_are_passed_on(tmp_path, encoder, monkeypatch):
    frames = [plain((255, 0, 0)), plain((0, 90, 255))]
    content = animation.save_animation(tmp_path / "a.mp4", frames, 12.5).read_bytes()
    command, _, raw = content.partition(b"|")
    options = command.decode().split()
    assert options[options.index("-s") + 1] == "40x30"
    assert options[options.index("-framerate") + 1] == "12.5"
    assert "h264" in options
    given = np.frombuffer(raw, dtype=np.uint8).reshape(2, 30, 40, 4)[..., :3]
    np.testing.assert_array_equal(given, np.stack(frames))  # without the few tones of a GIF
    with pytest.raises(KeyboardInterrupt):
        animation.save_animation(tmp_path / "a.mp4", [plain(0)] * 5, on_frame=stop_at_two)
    assert len((tmp_path / "a.mp4").read_bytes().partition(b"|")[2]) == 2 * 30 * 40 * 4
    encoder("print('Unknown encoder', file=sys.stderr); sys.exit(3)")
    with pytest.raises(OSError, match=r"b\.mp4: ffmpeg failed \(Unknown encoder\); write a \.gif"):
        animation.save_animation(tmp_path / "b.mp4", [plain(0)])
    with pytest.raises(InputError, match=r"frames\[1\]"):
        animation.save_animation(tmp_path / "b.mp4", [plain(0), plain(0, (9, 9))])
    assert not (tmp_path / "b.mp4").exists()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(tr.errors.MissingExtraError, match=r"b\.mp4 needs the program ffmpeg"):
        animation.save_animation(tmp_path / "b.mp4", [plain(0)])


def test_a_scene_plays_in_one_view(tools, ball, tmp_path):
    moving = torch.stack([ball.vertices + torch.tensor([shift, 0, 0]) for shift in (0.0, 3.0, torch.nan)])
    scene = Scene("", (MovingMesh("ball", moving, ball.faces, (1.0, 0.0, 0.0)),), captions=("0", "1", "2"))
    pictures, _ = tools.pictures_of(animation.animate_scene(tmp_path / "a.gif", scene, 10, size=(90, 60)))
    assert [picture.shape for picture in pictures] == [(60, 90, 3)] * 3
    red = [picture[..., 0] - picture[..., 1] > 60 for picture in pictures]
    across, area = [np.nonzero(mask)[1].mean() for mask in red[:2]], [mask.sum() for mask in red]
    assert abs(across[0] - across[1]) > 10
    assert area[1] > 0.5 * area[0] > 0
    assert area[2] == 0  # the shape was not found
    with pytest.raises(InputError, match="path must end in"):
        animation.animate_scene(tmp_path / "a.avi", scene)


@pytest.fixture(scope="module")
def tracked(plain_hand, plain_hand_skin, coarse, bend):
    """Frames, records and the result of a hand that is there, gone for a frame, and there again."""
    generator, records, frames = torch.Generator().manual_seed(0), [], []
    for pose in bend[:4]:
        surface, noise = coarse(pose), torch.rand(90, 3, generator=generator)
        points = surface[torch.randperm(len(surface), generator=generator)[:210]]
        frames.append(torch.cat([points, points.amin(0) + noise * (points.amax(0) - points.amin(0))]))
    frames[2] = frames[2][:0]
    tracker = tr.Tracker(plain_hand, bend[0], model_points=plain_hand_skin)
    return frames, records, tracker.run(frames, lambda points, record: records.append(record))


@pytest.fixture
def drawing(plain_hand, coarse, tracked):
    """Return the function that draws the first frame, with other arguments."""
    frames, records, _ = tracked
    view = figures.scene_view(figures.posed_scene(plain_hand, records[0].pose[None], skin=coarse), size=SIZE)

    def draw(pose=records[0].pose, data=frames[0], inliers=records[0].inliers, **options):
        scene = figures.posed_scene(plain_hand, pose[None], [data], [inliers], skin=coarse, **options)
        return pixels(figures.draw_scene(scene, view=view))

    return draw


def test_surfaces_without_data_are_gray_and_data_are_blue_or_gray(drawing, tracked):
    frames, records, _ = tracked
    nothing, none, inliers = frames[0][:0], torch.zeros(0) > 0, records[0].inliers
    found, held = drawing(data=nothing, inliers=none), drawing(data=nothing, inliers=none, usable=[False])
    assert (spread(found) > 30).mean() > 0.1
    assert (spread(held) > 30).mean() == 0
    # The same place, another color.
    np.testing.assert_array_equal(found.min(-1) < 250, held.min(-1) < 250)
    usual, outliers = drawing(), drawing(inliers=~inliers & False)
    assert (usual[..., 2] - usual[..., 0] > 60).sum() > 50
    assert (outliers[..., 2] - outliers[..., 0] > 60).sum() == 0
    unknown = drawing(pose=records[0].pose * torch.nan, inliers=torch.zeros_like(inliers))
    assert (spread(unknown) < 12).all()
    assert (unknown < 200).any()
    # Points that are not finite are left out.
    data, mask = torch.cat([frames[0], frames[0][:2] * torch.nan]), torch.cat([inliers, torch.ones(2) > 0])
    np.testing.assert_array_equal(drawing(data=data, inliers=mask), usual)
    corner = np.s_[-16:, :60]
    assert np.abs(drawing(captions=["12  lost"])[corner] - usual[corner]).max() > 100


@each_row(
    ((3, tr.Status.CONVERGED, "tracked"), "frame 3: tracked"),
    ((0, tr.Status.MAX_STEPS, "found"), "frame 0: found"),
    ((12, tr.Status.NO_DATA, "held"), "frame 12: no_data"),
)
def test_labels_name_the_source_of_a_pose_or_the_reason_for_none(arguments, label):
    assert tracking.frame_label(*arguments) == label


def test_overlays_show_each_frame_in_a_view_that_stays_until_the_hand_leaves(plain_hand, coarse, tracked, tmp_path):
    frames, records, _ = tracked
    overlays, views = tracking.FrameOverlays(plain_hand, coarse, size=SIZE), []
    for data, record in zip(frames, records, strict=True):
        assert png_size(overlays.save(tmp_path / "a.png", data, record)) == SIZE
        views.append(overlays._view)
    assert all(view is views[0] for view in views)
    gone = records[0].pose.clone()
    gone[0] += 0.3
    overlays.save(tmp_path / "gone.png", frames[0] + torch.tensor([0.3, 0.0, 0.0]), replace(records[0], pose=gone))
    places, _ = overlays._view.project(coarse(gone))
    assert overlays._view is not views[0]
    assert (places >= 0).all()
    assert (places <= places.new_tensor([2 * SIZE[0], 2 * SIZE[1]])).all()
    # The data of frames in which the shape was never found are shown too.
    tracker = tr.Tracker(plain_hand, config=tr.TrackConfig(recovery="none"))
    overlays = tracking.FrameOverlays(plain_hand, size=SIZE)
    for data in (frames[2], frames[0]):
        assert overlays.save(tmp_path / "b.png", data, tracker.step(data)).exists()
    assert (overlays._view.project(frames[0])[0] >= 0).all()


class Files:
    """Frames that are read when they are drawn, and which were read."""

    def __init__(self, frames):
        self.frames, self.read = frames, []

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, number):
        self.read.append(number)
        return self.frames[number]


def test_a_track_plays_with_the_inliers_of_the_tracker(tools, plain_hand, coarse, tracked, tmp_path):
    frames, records, result = tracked
    usual, files, calls = {"skin": coarse, "size": SIZE}, Files(frames), []
    inliers = [record.inliers for record in records]
    given = tracking.animate_track(
        tmp_path / "a.gif", plain_hand, result, files, inliers=inliers, on_frame=lambda *n: calls.append(n), **usual
    )
    assert calls == [(k, 4) for k in (1, 2, 3, 4)]
    assert files.read == [0, 1, 2, 3]
    pictures, _ = tools.pictures_of(given)
    assert pictures[0].shape == (SIZE[1], SIZE[0], 3)
    surface = [(spread(frame) > 30).mean() for frame in pictures]
    # The third frame has no data: its pose is a guess.
    assert surface[2] < 0.02 < 0.05 < min(surface[0], surface[1], surface[3])
    distances = [plain_hand.distance(data, pose).abs() for data, pose in zip(frames, result.poses, strict=True)]
    masks = [distance < 0.004 for distance in distances]
    one, other = (
        tools.pictures_of(tracking.animate_track(tmp_path / "b.gif", plain_hand, result, frames, **usual, **options))[0]
        for options in ({"inliers": masks}, {"inlier_distance": 0.004})
    )
    np.testing.assert_array_equal(one, other)
    lost, status = result.poses[:2] * torch.nan, (tr.Status.LOST,) * 2
    lost = replace(result, poses=lost, statuses=status, acquired=("lost",) * 2, times=result.times[:2])
    shown = tracking.animate_track(tmp_path / "c.gif", plain_hand, lost, [frames[2], frames[0]], **usual)
    assert (spread(np.stack(tools.pictures_of(shown)[0])) < 12).all()
    with pytest.raises(InputError, match="the shape was never found"):
        tracking.save_track_gltf(tmp_path / "a.glb", plain_hand, lost, skin=coarse)


@each_row(
    ({"frames": slice(3)}, r"result\.poses must have shape \(3, 27\), got \(4, 27\)"),
    ({"inliers": [torch.ones(3) > 0]}, r"inliers must hold one entry per pose \(4\), got 1"),
    ({"inliers": [torch.ones(3) > 0] * 4}, "inliers must have shape"),
    ({"inliers": [torch.ones(300)] * 4}, "inliers must"),
    ({"frames": slice(0), "poses": slice(0)}, "frames must hold at least one cloud"),
    ({"inlier_distance": 0.0}, "inlier_distance must be positive"),
    ({"path": "a.png"}, "path must end in"),
)
def test_animate_track_refuses(plain_hand, coarse, tracked, tmp_path, options, message):
    frames, _, result = tracked
    options = {"frames": slice(None), "poses": slice(None), "path": "a.gif", "skin": coarse, **options}
    frames, result = frames[options.pop("frames")], replace(result, poses=result.poses[options.pop("poses")])
    with pytest.raises(InputError, match=message):
        tracking.animate_track(tmp_path / options.pop("path"), plain_hand, result, frames, **options)
    assert list(tmp_path.iterdir()) == []
