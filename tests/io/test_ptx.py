"""Scans of laser scanners as text."""

import numpy as np
import pytest
import torch

from torchreg.errors import FileWarning, FormatError
from torchreg.io.points import load_points

POINTS = np.random.default_rng(4).normal(size=(50, 3)).round(4)


def read(tmp_path, name, text):
    (tmp_path / name).write_bytes(text.encode())
    return load_points(tmp_path / name, dtype=torch.float64)


def ptx(points, pose, tail="", counts=None):
    """Return a scan as text; the pose (4, 4) moves columns."""
    columns, rows = counts or (1, len(points))
    turn, place = pose[:3, :3], pose[:3, 3]
    head = [place, *turn.T, *pose.T]
    lines = [" ".join(f"{v:.9f}" for v in row) for row in head]
    lines += [" ".join(f"{v:.6f}" for v in row) + f" 0.5{tail}" for row in points]
    return "\n".join([str(columns), str(rows), *lines]) + "\n"


def turned(angle, place):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = place
    return pose


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("name", ["a.ptx", "a.txt"])
def test_scans_of_laser_scanners_stand_where_they_were_registered(tmp_path, newline, name):
    poses = turned(0.7, [10, -4, 1.5]), turned(-1.2, [3, 2, 1])
    seen = np.concatenate([POINTS, np.zeros((1, 3))])  # one direction without an echo
    text = ptx(seen, poses[0], " 255 0 51", (3, 17)) + ptx(POINTS, poses[1], " 0 255 51", (5, 10))
    with pytest.warns(FileWarning, match=r"1 of 101 points are 0 0 0, where nothing was measured"):
        cloud = read(tmp_path, name, text.replace("\n", newline))
    expected = np.concatenate([POINTS @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    np.testing.assert_allclose(cloud.points, expected, atol=1e-5)
    np.testing.assert_allclose(cloud.colors[[0, -1]], [[1, 0, 0.2], [0, 1, 0.2]])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("10\n5\n", "10\n6\n", r"a scan's head says 60 points, each of 3, 4, 6, 7 numbers; it holds 50 of 4"),
        ("10\n5\n", "10\n4\n", "line 51 must begin a scan"),
        (" 0.5", "", "must begin a scan|not a row of"),
        (" 0.5", " x", "'x'"),
        ("1.000000000\n", "2.000000000\n", "the motion of a scan must end in 0 0 0 1"),
        ("10\n5\n", "99999999\n5\n", "claims 499999995 points"),
    ],
)
def test_damaged_scans_are_refused(tmp_path, old, new, words):
    text = ptx(POINTS, turned(0.7, [10, -4, 1.5]), counts=(10, 5))
    head, _, tail = text.rpartition(old)
    text = head + new + tail if old == "1.000000000\n" else text.replace(old, new, 1)
    with pytest.raises(FormatError, match=rf"a\.ptx: .*{words}"):
        read(tmp_path, "a.ptx", text)


def test_colors_of_some_scans_and_scans_of_points_alone(tmp_path):
    text = ptx(POINTS, np.eye(4)) + ptx(POINTS, np.eye(4), " 1 2 3")
    with pytest.warns(FileWarning, match="colors are left out: 1 of 2 scans have them"):
        assert read(tmp_path, "a.ptx", text).colors is None
    text = ptx(POINTS, turned(0.3, (1, 2, 3))).replace(" 0.5\n", "\n")
    np.testing.assert_allclose(read(tmp_path, "b.ptx", text).points[:, 2], POINTS[:, 2] + 3, atol=1e-5)


def test_files_without_any_echo_are_refused(tmp_path):
    with pytest.raises(FormatError, match="all of its 4 points are 0 0 0: nothing was measured"):
        read(tmp_path, "a.ptx", ptx(np.zeros((4, 3)), turned(0.3, (1, 2, 3))))
