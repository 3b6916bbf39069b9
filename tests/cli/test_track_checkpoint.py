"""Progress of a tracker: files that come back to the last bit, damaged ones, parts of sequences."""

import json
import zipfile
from dataclasses import fields, replace
from types import SimpleNamespace

import pytest
import torch

import torchreg.cli.track_checkpoint as track_progress
from torchreg.cli.track_checkpoint import (
    TrackProgress,
    first_frames,
    join_frames,
    load_progress,
    save_progress,
)
from torchreg.cli.track_run import track_job
from torchreg.errors import FormatError, InputError
from torchreg.tracking.config import TrackConfig
from torchreg.tracking.tracker import Tracker

JOB = {"shape": "hand", "--start": [0.1, 1e-17], "--fps": 20.0, "options": [None, True], "inner": {"seed": 3}}


@pytest.fixture(scope="module")
def progress(plain_hand, plain_hand_skin):
    pose = plain_hand.rest_pose()
    pose[:3] += 0.3
    with torch.no_grad():
        cloud = plain_hand_skin(pose)
    tracker = Tracker(plain_hand, pose, model_points=plain_hand_skin)
    result = tracker.run([cloud, cloud[:0], cloud + 0.001], times=[0.1, 0.2, 0.3])
    return TrackProgress(result, tracker.state, JOB)


def alike(a, b):
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a.nan_to_num(-7), b.nan_to_num(-7))
    return type(a) is type(b) and a == b


def same(first, second):
    names = [item.name for item in fields(first) if item.name != "shape"]  # the command's own
    return all(alike(getattr(first, name), getattr(second, name)) for name in names)


def test_progress_comes_back_as_it_was(progress, tmp_path):
    path = tmp_path / "hand.progress"
    save_progress(path, progress)
    assert [file.name for file in tmp_path.iterdir()] == ["hand.progress"]
    loaded = load_progress(path)
    assert same(loaded.result, progress.result)
    assert same(loaded.state, progress.state)
    assert loaded.job == JOB
    save_progress(path, replace(progress, job={}))
    assert load_progress(path).job == {}


def test_a_crash_leaves_the_progress_before(progress, tmp_path, monkeypatch):
    save_progress(tmp_path / "p", progress)

    def crash(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(track_progress, "write_atomic", crash)
    with pytest.raises(KeyboardInterrupt):
        save_progress(tmp_path / "p", replace(progress, job={}))
    assert load_progress(tmp_path / "p").job == JOB


@pytest.mark.parametrize(
    ("member", "content", "message"),
    [
        ("job.json", b"{", "is no progress of a tracker"),
        ("job.json", b"[]", "must hold a TrackResult, a TrackState and what was to be done"),
        ("job.json", None, "no item named 'job.json'"),
        ("state.json", b"{}", "does not describe tensors"),
        ("state.safetensors", b"", "is damaged"),
        ("result.safetensors", None, "no item named 'result.safetensors'"),
    ],
)
def test_damaged_files_are_refused(progress, tmp_path, member, content, message):
    save_progress(tmp_path / "p", progress)
    with zipfile.ZipFile(tmp_path / "p") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members[member] = content
    with zipfile.ZipFile(tmp_path / "p", "w") as archive:
        for name, held in members.items():
            if held is not None:
                archive.writestr(name, held)
    with pytest.raises(FormatError, match=rf"/p: .*{message}"):
        load_progress(tmp_path / "p")


def test_what_does_not_belong_together_is_refused(progress, tmp_path):
    save_progress(tmp_path / "p", replace(progress, result=first_frames(progress.result, 2)))
    with pytest.raises(FormatError, match="has the state after 3 frames beside 2 results"):
        load_progress(tmp_path / "p")
    (tmp_path / "p").write_bytes(b"no archive")
    with pytest.raises(FormatError, match=r"/p: is no progress of a tracker, or damaged \(is not a readable zip"):
        load_progress(tmp_path / "p")
    with pytest.raises(FileNotFoundError):
        load_progress(tmp_path / "none")
    with pytest.raises(FileNotFoundError):
        save_progress(tmp_path / "none" / "p", progress)


def test_parts_make_the_whole(progress):
    whole = progress.result
    at_the_end = ("origin", "shape", "up", "coefficients", "coefficient_covariance")
    by_frame = [item.name for item in fields(whole) if item.name not in at_the_end]
    rest = replace(whole, **{name: getattr(whole, name)[1:] for name in by_frame})
    assert same(join_frames(first_frames(whole, 1), rest), whole)
    assert first_frames(whole, 0).poses.shape == (0, 27)
    assert same(join_frames(first_frames(whole, 0), whole), whole)
    for count in (-1, 4):
        with pytest.raises(InputError, match=f"count must be from 0 to 3, got {count}"):
            first_frames(whole, count)
    with pytest.raises(InputError, match="with 27 degrees of freedom and 21 keypoints, got 26 and 21"):
        join_frames(whole, replace(whole, poses=whole.poses[:, 1:]))


def test_what_decides_about_the_poses_comes_back_from_json(tmp_path):
    clouds = SimpleNamespace(names=["a", "b"])
    job = track_job("hand", (None,), torch.zeros(27), TrackConfig(upright=(0, 0, 1)), 20.0, 1.0, "omit", clouds)
    assert json.loads(json.dumps(job)) == job
