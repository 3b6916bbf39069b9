"""Tracking from the command line: what is printed and written, resumed runs, frames of no use, errors."""

import json
import re
import zipfile
from dataclasses import fields

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import torchreg as tr
import torchreg.shapes.skin as skin_module
import torchreg.tracking.frame_fit as fit_module
from tests.tables import each_row
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds
from torchreg.io.points import save_points

FRAMES = 6
FAST = ("--movie", "none", "--no-gltf")


def stacked(clouds, spare=0):
    """Return the arrays of an .npz of frames, with rows of NaN before each."""
    points = np.full((len(clouds), spare + max(map(len, clouds)), 3), np.nan, dtype=np.float32)
    for rows, cloud in zip(points, clouds, strict=True):
        rows[spare : spare + len(cloud)] = cloud
    return {"points": points, "counts": [spare + len(cloud) for cloud in clouds]}


@pytest.fixture(scope="module")
def sequence(plain_hand, plain_hand_surface, tmp_path_factory):
    """A folder with six frames in frames/, all of them in frames.npz, and the first pose in start.json."""
    place = tmp_path_factory.mktemp("sequence")
    poses = hand_motion(plain_hand, "bending_palm", FRAMES, seed=1)
    clouds = range_clouds(plain_hand, poses, num_points=400, camera=torch.zeros(3), skin=plain_hand_surface)
    (place / "frames").mkdir()
    for number, cloud in enumerate(clouds):
        save_points(place / "frames" / f"frame_{number:04d}.ply", cloud.points)
    np.savez(place / "frames.npz", **stacked([cloud.points for cloud in clouds]))
    (place / "start.json").write_text(json.dumps(poses[0].tolist()), encoding="utf-8")
    return place


@pytest.fixture
def command(sequence, tmp_path):
    """Return the arguments that track the sequence, with other options after them."""
    return lambda *options, frames=("frames",), out="r": (
        "track", "hand", *(sequence / name for name in frames), "-o", tmp_path / out,
        "--start", sequence / "start.json", *options,
    )  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def sampled_once():
    """Sample the points of the right hand once for all its trackers."""
    known = {}

    def sampled(shape, count, **options):
        if not isinstance(shape, tr.Hand) or shape.side != "right":
            return skin_module.sample_skin(shape, count, **options)
        key = (count, *options.items())
        first = known[key] = known.get(key) or skin_module.sample_skin(shape, count, **options)
        return tr.LinearBlendSkin(shape, first.points, first.weights, first.reference_pose, normals=first.normals)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "sample_skin", sampled)
        yield


@pytest.fixture(scope="module")
def whole(sequence, plain_hand, sampled_once):
    """What the library makes of the sequence."""
    frames = [tr.load_points(path).points for path in sorted((sequence / "frames").iterdir())]
    start = torch.tensor(json.loads((sequence / "start.json").read_text(encoding="utf-8")))
    return tr.Tracker(plain_hand, start).run(frames, times=[k / 20 for k in range(FRAMES)])


def same(first, second):
    """Return whether two tracks agree to the last bit in all but the time they took."""
    names = [item.name for item in fields(first) if item.name not in ("seconds", "shape")]
    pairs = [(getattr(first, name), getattr(second, name)) for name in names]
    return all(
        torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) if isinstance(a, torch.Tensor) else a == b for a, b in pairs
    )


def test_what_cannot_be_drawn_or_written_loses_no_result_and_is_told_once(run, command, whole, tmp_path, failing):
    failing(
        *(
            f"torchreg.viz.{name}"
            for name in ("tracking.save_scene", "tracking.animate_scene", "track_bvh.save_track_bvh")
        )
    )
    answer = run(*command("--pictures", tmp_path / "live", "--bvh", tmp_path / "r.bvh", "--quiet"))
    assert answer.exit_code == 1
    told = [line.split("/")[-1] for line in answer.output.splitlines() if "is not written" in line]
    assert [line.split(" is not written: ")[0] for line in told] == ["torchreg: warning: --pictures", "r.gif", "r.bvh"]
    assert same(tr.load(tmp_path / "r.safetensors"), whole)
    assert (tmp_path / "r.glb").exists()


def stop_at(monkeypatch, frame, error=KeyboardInterrupt):
    """Let the tracker be stopped while it works on a frame."""
    step = tr.Tracker.step

    def stopped(self, points, time=None, **told):
        if self.state.frame == frame:
            raise error
        return step(self, points, time, **told)

    monkeypatch.setattr(tr.Tracker, "step", stopped)


def test_a_sequence_is_tracked_and_everything_asked_for_is_written(done, command, whole, tmp_path):
    output = done(*command("--pictures", tmp_path / "live", "--bvh", tmp_path / "r.bvh"))
    assert f"{FRAMES} frames: {FRAMES} tracked; " in output
    names = ["live", "r.bvh", "r.gif", "r.glb", "r.json", "r.progress", "r.safetensors"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    result = tr.load(tmp_path / "r.safetensors")
    assert same(result, whole)
    assert result.times.tolist() == [k / 20 for k in range(FRAMES)]
    assert sorted(path.name for path in (tmp_path / "live").iterdir()) == [f"frame_000{k}.png" for k in range(FRAMES)]
    assert f"Frames: {FRAMES}\nFrame Time: 0.05\n" in (tmp_path / "r.bvh").read_text(encoding="utf-8")
    with Image.open(tmp_path / "r.gif") as file:
        assert (file.n_frames, file.info["duration"]) == (FRAMES, 50)
    assert tr.ArticulatedShape.from_gltf(tmp_path / "r.glb").part_names[0] == "palm"


def test_far_coordinates_keep_their_digits_and_are_drawn_near_zero(run, done, sequence, whole, tmp_path):
    far, start = torch.tensor([5e5, 4e6, 0.0]).double(), json.loads((sequence / "start.json").read_text())
    save_points(tmp_path / "far.xyz", tr.load_points(sequence / "frames" / "frame_0000.ply").points.double() + far)
    moved = [value + far[number].item() if number < 3 else value for number, value in enumerate(start)]
    (tmp_path / "far.json").write_text(json.dumps(moved), encoding="utf-8")
    command = "track", "hand", tmp_path / "far.xyz", "-o", tmp_path / "r", "--start", tmp_path / "far.json"
    output = done(*command, "--movie", "none")
    assert "r.glb holds coordinates from 500000 4" in output
    found = tr.load(tmp_path / "r.safetensors")
    torch.testing.assert_close(found.poses[0, :3] - far, whole.poses[0, :3].double(), atol=1e-3, rtol=0)
    assert np.abs(trimesh.load_scene(tmp_path / "r.glb").bounds).max() < 10
    assert run("export", tmp_path / "r", "--data", tmp_path / "far.xyz", "-o", tmp_path / "r.gif").exit_code == 0
    with Image.open(tmp_path / "r.gif") as file:  # data on the shape are blue
        colors = np.asarray(file.convert("RGB")).reshape(-1, 3).astype(int)
    assert ((colors[:, 2] > colors[:, 0] + 60) & (colors[:, 2] > 120)).sum() > 20


def test_archives_and_lists_of_files_are_sequences_too(run, command, whole, tmp_path):
    listed = [f"frames/frame_000{k}.ply" for k in (3, 0, 5, 2, 1, 4)]
    for frames in (["frames.npz"], listed):
        answer = run(*command("--force", "--quiet", *FAST, frames=frames))
        assert (answer.exit_code, answer.output) == (0, "")
        assert torch.allclose(tr.load(tmp_path / "r.safetensors").poses, whole.poses, atol=1e-5)


@pytest.mark.parametrize("frame", [1, 5])
def test_an_interrupted_run_goes_on_to_the_same_end(run, command, whole, tmp_path, monkeypatch, frame):
    with monkeypatch.context() as patch:
        stop_at(patch, frame)
        answer = run(*command("--save-every", 2, *FAST))
    assert answer.exit_code == 130
    assert f"interrupted; {frame} of {FRAMES} frames are done; --resume goes on from there" in answer.output
    part = tr.load(tmp_path / "r.safetensors")
    assert len(part.statuses) == len(part.poses) == frame
    done = []
    step = tr.Tracker.step
    monkeypatch.setattr(
        tr.Tracker, "step", lambda self, points, time, **told: done.append(time) or step(self, points, time, **told)
    )
    answer = run(*command("--save-every", 2, "--resume", *FAST))
    assert answer.exit_code == 0, answer.output
    assert len(done) == FRAMES - frame
    assert same(tr.load(tmp_path / "r.safetensors"), whole)


def test_a_killed_run_goes_on_from_what_was_saved_last(run, command, whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, 0)
        assert run(*command()).exit_code == 130
    assert list(tmp_path.iterdir()) == []
    with monkeypatch.context() as patch:
        stop_at(patch, 5, MemoryError)
        assert isinstance(run(*command("--save-every", 2, *FAST)).exception, MemoryError)
    assert [path.name for path in tmp_path.iterdir()] == ["r.progress"]
    assert run(*command("--resume", *FAST)).exit_code == 0
    assert same(tr.load(tmp_path / "r.safetensors"), whole)


def test_an_interruption_while_a_frame_is_drawn_leaves_no_hole(run, command, whole, tmp_path, monkeypatch):
    def draws(stops=False):
        def save(self, path, data, result):
            if stops and result.frame == 3:
                raise KeyboardInterrupt
            path.touch()

        return save

    monkeypatch.setattr("torchreg.viz.tracking.FrameOverlays.save", draws(stops=True))
    answer = run(*command("--pictures", tmp_path / "live", *FAST))
    assert "3 of 6 frames are done" in answer.output
    monkeypatch.setattr("torchreg.viz.tracking.FrameOverlays.save", draws())
    assert run(*command("--pictures", tmp_path / "live", "--resume", *FAST)).exit_code == 0
    assert len(list((tmp_path / "live").iterdir())) == FRAMES
    assert same(tr.load(tmp_path / "r.safetensors"), whole)


def test_a_complete_run_is_smoothed_at_its_end_or_later(done, command, whole, sequence, tmp_path):
    frames = [tr.load_points(path).points for path in sorted((sequence / "frames").iterdir())]
    wanted = tr.smooth_track(whole, frames)
    done(*command(*FAST, "--smooth"))
    once = tr.load(tmp_path / "r.safetensors")
    torch.testing.assert_close(once.poses, wanted.poses, atol=1e-4, rtol=0)
    assert once.statuses == whole.statuses
    done(*command(*FAST, out="s"))
    assert not torch.equal(tr.load(tmp_path / "s.safetensors").poses, once.poses)
    done(*command(*FAST, "--smooth", "--resume", out="s"))
    torch.testing.assert_close(tr.load(tmp_path / "s.safetensors").poses, once.poses)


def test_frames_that_came_later_are_added(run, command, whole, tmp_path, monkeypatch):
    some = [f"frames/frame_000{k}.ply" for k in range(4)]
    every = [*some, *(f"frames/frame_000{k}.ply" for k in (4, 5))]
    assert run(*command("--resume", *FAST, frames=some)).exit_code == 0
    assert run(*command("--resume", *FAST, frames=every)).exit_code == 0
    assert same(tr.load(tmp_path / "r.safetensors"), whole)
    stop_at(monkeypatch, FRAMES)
    # There is nothing left to do but to write.
    assert run(*command("--resume", "--movie", "none", frames=every)).exit_code == 0
    assert (tmp_path / "r.glb").exists()


def test_earlier_runs_are_neither_overwritten_nor_continued_by_another_command(run, error_of, command, tmp_path):
    frames = [f"frames/frame_000{k}.ply" for k in range(2)]
    assert run(*command(*FAST, frames=frames)).exit_code == 0
    assert "r.progress is how far an earlier run got; pass --resume to go on, or --force" in error_of(*command(*FAST))
    message = error_of(*command("--resume", "--points", 300, "--fps", 10, *FAST, frames=frames))
    assert "was written by another command: configuration, --fps differ" in message
    other = ["hand-left" if argument == "hand" else argument for argument in command("--resume", *FAST, frames=frames)]
    assert "was written by another command: shape differ" in error_of(*other)
    assert "frames differ" in error_of(*command("--resume", *FAST, frames=["frames/frame_0001.ply"]))
    assert run(*command("--force", "--points", 300, *FAST, frames=frames)).exit_code == 0
    (tmp_path / "r.progress").write_bytes(b"PK")
    assert "r.progress: is no progress of a tracker, or damaged" in error_of(*command("--resume", *FAST))
    (tmp_path / "r.progress").unlink()
    assert "r.safetensors exists; pass --force" in error_of(*command("--resume", *FAST))
    (tmp_path / "live").mkdir()
    (tmp_path / "live" / "frame_0007.png").touch()
    assert "frame_0007.png exists" in error_of(*command("--pictures", tmp_path / "live", *FAST, out="other"))


def test_frames_that_cannot_be_read_are_dropped(run, command, sequence, tmp_path):
    folder = tmp_path / "damaged"
    folder.mkdir()
    for path in (sequence / "frames").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "frame_0003.ply").write_bytes(b"ply\nbroken")
    answer = run(*command(*FAST, "--movie", "gif", frames=[folder]))
    assert answer.exit_code == 1
    assert answer.output.count("torchreg: warning: frame 3 is dropped: ") == 1
    assert "frame_0003.ply: must start with 'ply'" in answer.output
    assert "frame_0003.ply: no_data" in answer.output
    assert "frame_0004.ply: back (" in answer.output
    assert "6 frames: 5 tracked, 1 no_data" in answer.output
    result = tr.load(tmp_path / "r.safetensors")
    assert [status.usable for status in result.statuses] == [True, True, True, False, True, True]
    assert result.poses.shape == (FRAMES, 27)


def test_points_that_are_not_finite_are_left_out_or_drop_the_frame(run, command, sequence, tmp_path):
    frames = [tr.load_points(path).points for path in sorted((sequence / "frames").iterdir())][:2]
    np.savez(tmp_path / "f.npz", **stacked(frames, spare=1))
    assert run(*command(*FAST, "--quiet", frames=[tmp_path / "f.npz"])).exit_code == 0
    answer = run(*command(*FAST, "--quiet", "--force", "--nan-policy", "raise", frames=[tmp_path / "f.npz"]))
    assert answer.exit_code == 1
    assert "frame 0 is dropped: " in answer.output
    assert "are not finite" in answer.output


def test_millimeters_taken_for_meters_are_warned_of_once(run, command, sequence, whole, tmp_path):
    (tmp_path / "mm").mkdir()
    for path in (sequence / "frames").iterdir():
        save_points(tmp_path / "mm" / path.name, 1000 * tr.load_points(path).points)
    answer = run(*command(*FAST, frames=[tmp_path / "mm"]))
    assert answer.exit_code == 1
    assert answer.output.count("torchreg: warning: the data spread over") == 1
    assert "6 frames: 0 tracked, 6 other_units" in answer.output
    assert tr.load(tmp_path / "r.safetensors").statuses == (tr.Status.OTHER_UNITS,) * FRAMES
    assert run(*command(*FAST, "--force", "--scale", "0.001", frames=[tmp_path / "mm"])).exit_code == 0
    assert torch.allclose(tr.load(tmp_path / "r.safetensors").poses, whole.poses, atol=1e-3)


def test_options_reach_the_tracker(run, command, interrupted):
    given = interrupted("torchreg.tracking.tracker.Tracker")
    options = ("--prediction", "none", "--points", 300, "--model-points", "data", "--recovery", "starts", "--seed", 4,
               "--locked", "base", "--upright", "--up", "-z")  # fmt: skip
    run(*command(*options))
    (((_, pose), known),) = given
    assert (known["fit_shape"], known["locked"], pose.shape) == (False, ("base",), (27,))
    assert known["config"] == tr.TrackConfig(
        prediction="none", num_model_points=300, model_points="data", recovery="starts", seed=4, upright=(0, 0, -1)
    )


def test_without_a_start_the_shape_is_searched_for(done, sequence, tmp_path, monkeypatch):
    start = torch.tensor(json.loads((sequence / "start.json").read_text(encoding="utf-8")))
    asked = []

    def found(shape, data, **options):
        asked.append(len(data))
        return tr.PoseStarts(start[None], torch.zeros(1), torch.ones(()))

    monkeypatch.setattr("torchreg.tracking.recovery.find_pose", found)
    done("track", "hand", sequence / "frames", "-o", tmp_path / "r", *FAST)
    # What was found everywhere is checked by the same search in one more frame.
    assert len(asked) == 2
    assert tr.load(tmp_path / "r.safetensors").acquired[0] == "found"


def test_what_is_never_found_has_a_picture_and_no_gltf(run, sequence, tmp_path):
    answer = run(
        "track", "hand", sequence / "frames/frame_0000.ply", "-o", tmp_path / "r", "--recovery", "none",
        "--pictures", tmp_path / "live",
    )  # fmt: skip
    assert answer.exit_code == 1, answer.output
    assert "1 frame: 0 tracked, 1 not_found" in answer.output
    names = ["live", "r.gif", "r.json", "r.progress", "r.safetensors"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert not tr.load(tmp_path / "r.safetensors").poses.isfinite().any()
    assert (tmp_path / "live" / "frame_0000.png").exists()


def test_a_robot_is_tracked(done, folder, tmp_path):
    pose = tr.ArticulatedShape.from_urdf(folder / "arm.urdf", free_base=False).rest_pose()
    (tmp_path / "start.json").write_text(json.dumps(pose.tolist()), encoding="utf-8")
    done(
        "track", folder / "arm.urdf", folder / "arm.npz", "-o", tmp_path / "r", "--start", tmp_path / "start.json",
        *FAST,
    )  # fmt: skip
    assert abs(tr.load(tmp_path / "r.safetensors").poses[0, 0].item() - 0.02) < 0.005


def test_encoders_tell_joints_of_every_frame(run, error_of, folder, tmp_path):
    arm = "track", folder / "arm.urdf", folder / "arm.npz", *FAST
    (tmp_path / "start.json").write_text(json.dumps([0.02] + [0.0] * 7), encoding="utf-8")
    (tmp_path / "joints.csv").write_text("shoulder\n0.25\n")
    known = "--locked", "base", "--joints", tmp_path / "joints.csv", "--joint-std", "0.001deg"
    answer = run(*arm, "-o", tmp_path / "r", "--start", tmp_path / "start.json", *known)
    poses = tr.load(tmp_path / "r.safetensors").poses
    torch.testing.assert_close(poses[:, :6], torch.tensor([0.02] + [0.0] * 5).expand(len(poses), -1), atol=1e-6, rtol=0)
    torch.testing.assert_close(poses[:, 6], torch.full_like(poses[:, 6], 0.25), atol=1e-3, rtol=0)
    assert answer.exit_code in (0, 1)
    (tmp_path / "joints.csv").write_text("shoulder\n40\n")
    assert "beyond its limits" in error_of(*arm, "-o", tmp_path / "s", *known)


@each_row(
    ({"frames": ["none.ply"]}, "none.ply: No such file or directory"),
    ({"frames": ["start.json"]}, "has the unknown ending '.json'"),
    (("--start", "none.json"), "none.json: No such file or directory"),
    (("--movie", "avi"), "--movie must be one of gif, mp4, none; got 'avi'"),
    (("--clothed", "no"), "--clothed has no meaning without --fit-shape"),
    (("--clothed", "maybe", "--fit-shape"), "--clothed must be one of auto, yes, no"),
    (("--fps", 0), "--fps must be positive"),
    (("--scale", -1), "--scale must be positive"),
    (("--prediction", "maybe"), "prediction must be one of velocity, none"),
    (("--model-points", "few"), "model_points must be one of seen, data, shape"),
    (("--nan-policy", "keep"), "nan_policy must be one of raise, omit"),
    (("--points", 0), "num_model_points must be at least 1"),
    (("--fixed-base",), "--free-base/--fixed-base has no meaning for hand"),
    (("--gltf", "a.glb", "--no-gltf"), "--gltf and --no-gltf cannot be used together"),
    (("--poses", "a.txt"), "a.txt must end in .csv"),
    (("--reach", 0.1), "--reach has no meaning without --stereo"),
    (("--depth-range", 1, 2), "--depth-range has no meaning without --stereo or --depth"),
    (("--depth",), "--depth takes --intrinsics FILE with the camera"),
    ({"out": "no/r"}, "no does not exist; create it first"),
    (("--pictures", "no/live"), "live: No such file or directory"),
)
def test_errors_are_one_line(error_of, command, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in error_of(*(command(**options) if isinstance(options, dict) else command(*options)))
    assert list(tmp_path.iterdir()) == []


def test_movies_in_mp4_need_ffmpeg_before_anything_is_done(error_of, command, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "r.mp4 needs the program ffmpeg, which is not there" in error_of(*command("--movie", "mp4"))


def test_the_bones_of_a_rig_are_fitted_over_the_frames(folder, run, error_of, tmp_path):
    vertices = tr.load_points(folder / "flat.glb").points
    for number in range(2):
        save_points(tmp_path / f"frame{number}.ply", 1.1 * vertices + torch.tensor([0.01 * number, 0.0, 0.0]))
    (tmp_path / "start.json").write_text("{}", encoding="utf-8")
    common = (
        "track", folder / "flat.glb", tmp_path / "frame0.ply", tmp_path / "frame1.ply", "--parents",
        folder / "parents.json", "--start", tmp_path / "start.json", "-o", tmp_path / "r", *FAST, "--fit-shape",
    )  # fmt: skip
    answer = run(*common)
    assert answer.exit_code in (0, 1), answer.output
    # An open cone slides along itself as it grows: what its size is, it does not tell.
    assert re.search(r"; size -?0\.\d\d \+- 0\.\d\d, girth ", answer.output)
    found = tr.load(tmp_path / "r.safetensors")
    assert found.coefficients.shape == (2 + 2 * 3,)
    assert float(found.residuals[-1]) < 0.003
    assert "fit_shape goes without" in error_of(*common, "--force", "--locked", "base")


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(path, members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if content is not None:
                archive.writestr(name, content)


@each_row(
    ("job.json", b"{", "is no progress of a tracker"), ("job.json", None, "no item named 'job.json'"),
    ("state.json", b"{}", "does not describe tensors"), ("state.safetensors", b"", "is damaged"),
    ("job.json", b"[]", "must hold a TrackResult, a TrackState and what was to be done"),
    ("result.safetensors", None, "no item named 'result.safetensors'"),
)  # fmt: skip
def test_damaged_progress_is_refused(run, error_of, command, tmp_path, member, content, message):
    one = command("--resume", *FAST, frames=["frames/frame_0000.ply"])
    assert run(*one).exit_code == 0
    pack(tmp_path / "r.progress", members_of(tmp_path / "r.progress") | {member: content})
    assert message in error_of(*one)


def test_frames_that_changed_since_and_states_of_other_results_are_refused(run, error_of, command, sequence, tmp_path):
    (tmp_path / "mine").mkdir()
    paths = [tmp_path / "mine" / f"{number}.ply" for number in range(2)]
    for number, path in enumerate(paths):
        path.write_bytes((sequence / "frames" / f"frame_000{number}.ply").read_bytes())
    own = command("--resume", *FAST, frames=paths)
    assert run(*own).exit_code == 0
    kept = paths[1].read_bytes()
    save_points(paths[1], torch.rand(200, 3, generator=torch.Generator().manual_seed(0)))
    message = error_of(*own)
    assert f"{paths[1]} changed since" in message
    assert "--force without --resume" in message
    paths[1].write_bytes(kept)
    assert not list(tmp_path.glob(".*.lock"))
    short = members_of(tmp_path / "r.progress")
    assert run(*command("--force", *FAST, frames=paths[:1])).exit_code == 0
    one = members_of(tmp_path / "r.progress")
    pack(tmp_path / "r.progress", short | {name: one[name] for name in ("result.safetensors", "result.json")})
    assert "has the state after 2 frames beside 1 results" in error_of(*own)


def test_every_frame_is_shown_while_it_is_tracked(done, command, sequence, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the viewer needs viser")
    shown = []
    monkeypatch.setattr(
        "torchreg.viz.live_track.LiveTrack.show", lambda self, points, frame: shown.append((len(points), frame.frame))
    )
    frames = ["frames/frame_0000.ply", "frames/frame_0001.ply"]
    output = done(*command(*FAST, "--view", "--port", "0", "--no-browser", frames=frames))
    assert "http://127.0.0.1:" in output
    assert shown == [(len(tr.load_points(sequence / name)), number) for number, name in enumerate(frames)]
