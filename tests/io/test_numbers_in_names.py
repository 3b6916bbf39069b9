"""The order of files by the numbers in their names."""

from pathlib import Path

import pytest
import torch

from torchreg.errors import FileWarning
from torchreg.io.frames import load_frames
from torchreg.io.images import list_frames, list_pictures
from torchreg.io.natural_order import natural_sorted


@pytest.mark.parametrize(
    "names",
    [
        ["frame_0.5.xyz", "frame_1.0.xyz", "frame_1.25.xyz", "frame_1.5.xyz", "frame_10.0.xyz"],
        ["t=0.05.png", "t=0.1.png", "t=0.25.png", "t=0.3.png"],
        ["t=-2.ply", "t=-0.5.ply", "t=0.ply", "t=1.ply"],
        ["scan-2.ply", "scan-9.ply", "scan-10.ply"],
        ["2024.01.15.ply", "2024.02.01.ply", "2024.10.01.ply"],
        ["take1.1.ply", "take1.2.ply", "take1.10.ply", "take2.1.ply"],
        ["walk.1.ply", "walk.2.ply", "walk.10.ply"],
        ["a1b2.ply", "a1b10.ply", "a2b1.ply"],
        ["9.ply", "10.ply", "10a.ply", "b.ply"],
        ["0.0.xyz", "5e-05.xyz", "0.0001.xyz", "0.00015.xyz", "1.5E-3.xyz", "1e+02.xyz", "1.25e3.xyz"],
        ["t=-1e-3.ply", "t=-2e-04.ply", "t_0.ply", "t_1e-3_b2.ply", "t_1e-3_b10.ply", "t_0.01.ply"],
        ["s1e2.ply", "s1e10.ply", "s2e1.ply"],
        ["3e-9f.ply", "3e-10f.ply"],
        ["12_95000000.ply", "12_100000000.ply", "13_5.ply"],
        ["v1.2.9.ply", "v1.2.10.ply", "v1.10.1.ply"],
    ],
)
def test_names_sort_as_a_person_would(names):
    # take1.1 and take1.10 would be one number: there the point separates two counters.
    if "take1.1.ply" in names:
        names = [*names, "take1.100.ply"]
        names.sort(key=lambda name: [int(part) for part in name.removeprefix("take").removesuffix(".ply").split(".")])
    assert [path.name for path in natural_sorted(map(Path, reversed(names)))] == names


def test_frames_and_pictures_come_in_this_order(tmp_path):
    times = (0.5, 1.0, 1.25, 1.5, 10.0)
    for time in times:
        (tmp_path / f"frame_{time}.xyz").write_text(f"{time} 0 0\n0 1 0\n0 0 1\n")
    assert [float(cloud[0, 0]) for cloud in load_frames(tmp_path)] == list(times)
    listed = [tmp_path / f"frame_{time}.xyz" for time in reversed(times)]
    assert [float(cloud[0, 0]) for cloud in load_frames(listed)] == list(times)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for time in (0.3, 0.05, 0.25, 0.1):
            (tmp_path / side / f"t={time}.png").touch()
    assert [path.name for path in list_pictures(tmp_path / "left")] == [f"t={t}.png" for t in (0.05, 0.1, 0.25, 0.3)]
    assert list_frames([tmp_path / "left", tmp_path / "right"])[0][1].name == "t=0.05.png"
    (tmp_path / "left" / "t=0.05.png").rename(tmp_path / "left" / "t=5e-2.png")
    assert list_frames([tmp_path / "left", tmp_path / "right"])[0][0].name == "t=5e-2.png"


def test_notes_beside_frames_are_passed_over_and_told(tmp_path):
    for number in range(2):
        (tmp_path / f"{number}.xyz").write_text("0 0 0\n")
    (tmp_path / "times.csv").write_text("frame,time\n0,0\n")
    with pytest.warns(FileWarning, match=r"its 2 \.xyz files are the frames; times\.csv beside them are passed over"):
        assert len(load_frames(tmp_path)) == 2


def test_one_array_of_frames(tmp_path):
    import numpy as np

    stack = np.arange(24.0).reshape(2, 4, 3)
    np.save(tmp_path / "s.npy", stack)
    frames = load_frames(tmp_path / "s.npy", scale=0.5)
    assert torch.equal(torch.stack(list(frames)), torch.from_numpy(stack / 2).float())
    assert frames.names[1].endswith("s.npy, frame 1")
