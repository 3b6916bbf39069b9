"""Rows 0 0 0, which depth cameras, scanners and padding leave where nothing was measured, and normals 0 0 0."""

import warnings

import numpy as np
import pytest
import torch

from torchreg.errors import FileWarning, FormatError
from torchreg.io.frames import load_frames, save_frames
from torchreg.io.points import load_mesh, load_points, save_points
from torchreg.io.scans import load_scan

RNG = np.random.default_rng(0)
POINTS = RNG.normal((0, 0, 2), size=(12, 3)).round(3)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
COLORS = RNG.integers(0, 256, (12, 3))
MEASURED = np.sort(RNG.permutation(20)[:12])


def gappy(values, like=None):
    """Return rows (20, C) with values at the measured ones, and zeros between."""
    rows = np.zeros((20, values.shape[1]), like or values.dtype)
    rows[MEASURED] = values
    return rows


def text(rows, separator=" "):
    return "".join(separator.join(f"{v:.9g}" for v in row) + "\n" for row in rows.tolist())


PLY = "ply\nformat ascii 1.0\nelement vertex 20\n" + "".join(f"property float {n}\n" for n in "xyz")
PCD = (
    "VERSION .7\nFIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nWIDTH 5\nHEIGHT 4\n"
    "POINTS 20\nDATA ascii\n"
)


def writers(path):
    """Return the ways to write the gappy cloud, with normals and colors where the format has them."""
    both, rows = np.concatenate([gappy(POINTS), gappy(NORMALS)], 1), gappy(POINTS)
    head = PLY + "".join(f"property float normal_{n}\n" for n in "xyz") + "end_header\n"
    return {
        "xyz": lambda: path.write_text(text(rows).replace("0 0 0\n", "0.0 -0.0 0\n")),
        "csv": lambda: path.write_text("x,y,z,nx,ny,nz,r,g,b\n" + text(np.concatenate([both, gappy(COLORS)], 1), ",")),
        "ply": lambda: path.write_text(head + text(both)),
        "pcd": lambda: path.write_text(PCD + text(both)),
        "npz": lambda: np.savez(path, points=rows, normals=gappy(NORMALS), colors=gappy(COLORS, "u1")),
        "npy": lambda: np.save(path, rows.reshape(4, 5, 3)),
        "obj": lambda: path.write_text("".join(f"v {line}\n" for line in text(rows).splitlines())),
    }


@pytest.mark.parametrize("ending", ["xyz", "csv", "ply", "pcd", "npz", "npy", "obj"])
@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_rows_without_a_measurement_are_left_out_with_all_that_goes_with_them(tmp_path, ending, scale):
    path = tmp_path / f"a.{ending}"
    writers(path)[ending]()
    with pytest.warns(FileWarning, match=rf"a\.{ending}: 8 of 20 points are 0 0 0, where nothing was measured; they"):
        cloud = load_points(path, scale=scale, dtype=torch.float64)
    np.testing.assert_allclose(cloud.points, POINTS * scale, rtol=1e-6)
    assert (cloud.normals is None) == (ending in ("xyz", "npy", "obj"))
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)
    if cloud.colors is not None:
        np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-6)


def test_whole_millimeters_and_points_of_maps(tmp_path):
    counts = np.round(gappy(POINTS) * 1000).astype("i2").reshape(4, 5, 3)
    np.save(tmp_path / "a.npy", counts)
    with pytest.warns(FileWarning, match="8 of 20 points are 0 0 0"):
        scan = load_scan(tmp_path / "a.npy", scale=0.001)
    np.testing.assert_allclose(scan.points, np.round(POINTS * 1000) / 1000, atol=1e-6)
    np.save(tmp_path / "m.npy", gappy(POINTS + np.array([4e5, 5e6, 0])))
    with pytest.warns(FileWarning, match="8 of 20"):  # zeros are no reason to read maps in single precision
        assert load_points(tmp_path / "m.npy").points.dtype == torch.float64


def test_the_origin_itself_and_corners_of_faces_stay(tmp_path):
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert len(load_points(tmp_path / "a.xyz")) == 3
    (tmp_path / "one.xyz").write_text("0 0 0\n")
    assert load_points(tmp_path / "one.xyz").points.tolist() == [[0, 0, 0]]
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]], float)
    save_points(tmp_path / "m.ply", vertices, faces=[[0, 1, 2], [3, 2, 4]])
    assert len(load_mesh(tmp_path / "m.ply").vertices) == 5
    grid = np.concatenate([np.zeros((4, 3)), vertices])
    save_points(tmp_path / "g.ply", grid, faces=[[4, 5, 6], [7, 6, 8]])
    with pytest.warns(FileWarning, match="4 of 9 points are 0 0 0"):
        mesh = load_mesh(tmp_path / "g.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 2, 4]]
    np.testing.assert_array_equal(mesh.vertices, vertices)


def test_rows_that_are_not_finite_are_judged_by_themselves(tmp_path):
    rows = gappy(POINTS)
    rows[MEASURED[0]] = np.nan
    np.save(tmp_path / "a.npy", rows)
    with pytest.raises(FormatError, match="1 of 12 points are not finite"):
        load_points(tmp_path / "a.npy")
    with pytest.warns(FileWarning, match="8 of 20"):
        assert len(load_points(tmp_path / "a.npy", nan_policy="omit")) == 11


def test_clouds_without_any_measurement_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 5, 3), "i2"))
    with pytest.raises(FormatError, match=r"a\.npy: all of its 20 points are 0 0 0: nothing was measured"):
        load_points(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 5, 3)))
    with pytest.raises(FormatError, match=r"a\.npz: all of its 10 points are 0 0 0"):
        load_frames(tmp_path / "a.npz")


@pytest.mark.parametrize("ending", ["npz", "npy"])
def test_padding_of_stacks_is_told_once_with_its_total(tmp_path, ending):
    stack = np.zeros((4, 12, 3), "f4")
    for frame, count in enumerate((12, 11, 9, 0)):
        stack[frame, :count] = POINTS[:count]
    save = {"npz": lambda path: np.savez(path, points=stack), "npy": lambda path: np.save(path, stack)}[ending]
    save(tmp_path / f"a.{ending}")
    with pytest.warns(FileWarning) as told:
        frames = load_frames(tmp_path / f"a.{ending}")
    assert [len(frame) for frame in frames] == [12, 11, 9, 0]
    assert [str(row.message).split(f"a.{ending}: ")[1] for row in told] == [
        "16 of 48 points in 3 of 4 frames are 0 0 0, where nothing was measured; they are left out"
    ]
    np.testing.assert_allclose(frames[2], POINTS[:9], rtol=1e-6)


def test_organized_sequences_and_origins_that_are_points(tmp_path):
    stack = np.stack([gappy(POINTS), gappy(POINTS + 1)]).reshape(2, 4, 5, 3)
    np.save(tmp_path / "a.npy", stack)
    with pytest.warns(FileWarning, match="16 of 40 points in 2 of 2 frames"):
        frames = load_frames(tmp_path / "a.npy")
    np.testing.assert_allclose(frames[1], POINTS + 1, rtol=1e-6)
    stack = np.stack([POINTS, POINTS + 1])
    stack[:, 0] = 0  # wrists of hands, say
    np.savez(tmp_path / "w.npz", points=stack)
    assert [len(frame) for frame in load_frames(tmp_path / "w.npz")] == [12, 12]


def test_files_of_a_sequence_tell_of_the_first_that_it_concerns(tmp_path):
    for number in range(5):
        rows = POINTS + number if number == 0 else gappy(POINTS + number)
        (tmp_path / f"f{number}.xyz").write_text(text(rows))
    frames = load_frames(tmp_path)
    with pytest.warns(FileWarning) as told:
        assert [len(frame) for frame in [*frames, *frames[2:]]] == [12] * 8
    assert len(told) == 1
    assert str(told[0].message).endswith(
        "f1.xyz: 8 of 20 points are 0 0 0, where nothing was measured; they are left out; of other frames this is not "
        "told again"
    )


def test_frames_that_were_saved_are_read_as_they_are(tmp_path):
    made = [torch.from_numpy(POINTS), torch.from_numpy(POINTS[:5])]
    save_frames(tmp_path / "a.npz", made)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [len(frame) for frame in load_frames(tmp_path / "a.npz")] == [12, 5]


@pytest.mark.parametrize("names", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")])
def test_normals_of_length_zero_are_none(tmp_path, names):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)

    def write(normals, faces=""):
        head = f"ply\nformat ascii 1.0\nelement vertex {len(normals)}\n"
        head += "".join(f"property float {n}\n" for n in ("x", "y", "z", *names))
        head += "element face 1\nproperty list uchar int vertex_indices\n" if faces else ""
        rows = text(np.concatenate([vertices, normals], 1))
        (tmp_path / "a.ply").write_text(head + "end_header\n" + rows + faces)
        return load_points(tmp_path / "a.ply")

    with pytest.warns(FileWarning, match=r"a\.ply: normals are left out: 3 of 3 normals are of length zero"):
        assert write(np.zeros((3, 3))).normals is None
    some = np.array([[0, 0, 0], [0, 0, 1], [np.nan, 0, 0]])
    with pytest.warns(FileWarning, match="left out: 1 of 3 normals are not finite, 1 of 3 normals are of length zero"):
        assert write(some).normals is None
    with pytest.warns(FileWarning, match="of length zero; they are computed from the faces"):
        assert write(np.zeros((3, 3)), "3 0 1 2\n").normals.tolist() == [[0, 0, 1]] * 3
    assert write(np.array([[0, 0, 2.0]] * 3)).normals.tolist() == [[0, 0, 2]] * 3
