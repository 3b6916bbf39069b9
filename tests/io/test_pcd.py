"""PCD: encodings, LZF, packed colors, damaged headers."""

import contextlib
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.pcd import decompress_lzf, read_pcd
from torchreg.io.points import load_points

HEADER = (
    "# .PCD v.7\nVERSION .7\nFIELDS x normal_x y rgb z normal_y extra normal_z\nSIZE 8 4 8 4 8 4 2 4\n"
    "TYPE F F F {rgb} F F U F\nCOUNT 1 1 1 1 1 1 2 1\nWIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\n"
    "POINTS 6\nDATA {data}\n"
)
RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.normal(size=(6, 3)), RNG.normal(size=(6, 3)).astype(np.float32)
COLORS = np.array([[1, 2, 3], [255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7], [127, 128, 129]])


def columns() -> list[np.ndarray]:
    packed = ((COLORS[:, 0] << 16) | (COLORS[:, 1] << 8) | COLORS[:, 2]).astype("<u4")
    x, y, z = POINTS.T.astype("<f8")
    nx, ny, nz = NORMALS.T.astype("<f4")
    return [x, nx, y, packed, z, ny, np.ones((6, 2), "<u2"), nz]


def compress(data: bytes) -> bytes:
    """A minimal LZF encoder: runs of one byte become copies of what stands just before, all else literals."""
    out, place = bytearray(), 0
    while place < len(data):
        run = 1
        while place + run < len(data) and data[place + run] == data[place] and run < 265:
            run += 1
        if run >= 4:
            out += bytes([0, data[place]])
            length = run - 1 - 2
            out += bytes([(7 << 5), length - 7, 0]) if length >= 7 else bytes([length << 5, 0])
            place += run
        else:
            out += bytes([0, data[place]])
            place += 1
    return bytes(out)


def file(data: str, rgb: str = "F") -> bytes:
    header = HEADER.format(data=data, rgb=rgb).encode()
    if data == "ascii":
        rows = []
        for k in range(6):
            values = [column[k] for column in columns()]
            packed = values[3].view("<f4") if rgb == "F" else values[3]
            values[3] = packed
            rows.append(" ".join(repr(v.item()) if v.ndim == 0 else " ".join(map(str, v)) for v in values))
        return header + "\n".join(rows).encode() + b"\n"
    if data == "binary":
        return header + b"".join(b"".join(column[k].tobytes() for column in columns()) for k in range(6))
    plain = b"".join(column.tobytes() for column in columns())
    packed = compress(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("rgb", ["F", "U"])
def test_all_encodings_agree(tmp_path, data, rgb):
    path = tmp_path / "a.pcd"
    path.write_bytes(file(data, rgb))
    cloud = load_points(path, dtype=torch.float64)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS.astype(np.float64))
    np.testing.assert_allclose(cloud.colors * 255, COLORS, atol=1e-9)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_files_cut_off_or_too_long_are_refused(data):
    whole = file(data)
    start = whole.index(b"DATA")
    for end in range(start, len(whole) - (20 if data == "ascii" else 1), 3):
        with pytest.raises(FormatError):
            read_pcd(whole[:end], DEFAULT_LIMITS)
    with pytest.raises(FormatError, match="cut off or damaged"):
        read_pcd(whole + b"1 2 3 4 5 6 7 8 9\n", DEFAULT_LIMITS)
    if data != "ascii":
        read_pcd(whole + b"\0\0\n", DEFAULT_LIMITS)  # padding to a page


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("DATA ascii", "DATA", "must have a header closed by a line 'DATA ascii'"),
        ("DATA ascii", "DATA zipped", "DATA 'zipped' is unknown"),
        ("FIELDS x ", "FIELDS y ", "FIELDS are missing or not unique"),
        ("FIELDS x ", "FIELDS w ", "must have the fields x, y and z, got w, normal_x"),
        ("SIZE 8 4", "SIZE 8", "must be equally long"),
        ("SIZE 8 4", "SIZE 3 4", "'x' has an unknown TYPE 'F' of SIZE '3'"),
        ("COUNT 1", "COUNT 0", "has the COUNT '0'"),
        ("WIDTH 3", "WIDTH 4", "POINTS is not WIDTH x HEIGHT"),
        ("POINTS 6", "POINTS six", "POINTS must be a number, got 'six'"),
        ("WIDTH 3\nHEIGHT 2\n", "WIDTH 7\nHEIGHT 1\n", "POINTS is not"),
        ("VERSION .7", "VERSION .7\nVERSION .7", "says VERSION twice"),
        ("WIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6", "WIDTH 0\nHEIGHT 1\nPOINTS 0", "holds no points"),
        ("\nPOINTS 6", "\nPOINTS 999999999999", "POINTS is not"),
    ],
)
def test_damaged_headers_are_refused(old, new, words):
    whole = file("ascii").decode()
    assert old in whole
    with pytest.raises(FormatError, match=words):
        read_pcd(whole.replace(old, new, 1).encode(), DEFAULT_LIMITS)


def test_defaults_of_old_headers():
    text = "FIELDS x y z _ _\nSIZE 4 4 4 1 1\nTYPE F F F U U\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 3 0 0\n"
    assert read_pcd(text.encode(), DEFAULT_LIMITS).points.tolist() == [[1, 2, 3]]


def test_lzf_of_known_blocks():
    # "abc" as literals, then 5 bytes from 3 back (overlapping), then 20 from 1 back in the long form.
    packed = bytes([2]) + b"abc" + bytes([(3 << 5), 2]) + bytes([(7 << 5), 11, 0])
    assert decompress_lzf(packed, 28) == b"abc" + b"abcab" + b"b" * 20
    distant = bytes([31]) + bytes(range(32)) * 1
    assert decompress_lzf(distant * 10 + bytes([(1 << 5) | 1, 63]), 323) == bytes(range(32)) * 10 + bytes(range(3))
    for wrong in (packed[:-1], packed[:-3], packed + b"\0", bytes([(1 << 5), 0])):
        with pytest.raises(FormatError, match="compressed block"):
            decompress_lzf(wrong, 28)
    with pytest.raises(FormatError, match="does not expand to the 27 bytes"):
        decompress_lzf(packed, 27)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 255), st.integers(1, 600)), max_size=8))
def test_lzf_undoes_a_run_length_encoder(runs):
    data = b"".join(bytes([value]) * count for value, count in runs)
    assert decompress_lzf(compress(data), len(data)) == data


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 500))
def test_lzf_of_noise_ends(noise, size):
    with contextlib.suppress(FormatError):
        assert len(decompress_lzf(noise, size)) == size


def test_compressed_blocks_that_claim_too_much_are_refused():
    whole = file("binary_compressed")
    start = whole.index(b"compressed\n") + 11
    claim = HEADER.replace("WIDTH 3", "WIDTH 3000000").replace("POINTS 6", "POINTS 6000000").replace("{rgb}", "F")
    claim = claim.format(data="binary_compressed").encode()
    with pytest.raises(FormatError, match="the compressed block of 400 bytes is cut off or damaged"):
        read_pcd(claim + struct.pack("<II", 400, 6_000_000 * 44) + b"\0" * 400, DEFAULT_LIMITS)
    with pytest.raises(FormatError, match="header's counts need 264000000 bytes"):
        read_pcd(claim + whole[start:], DEFAULT_LIMITS)
    with pytest.raises(FormatError, match=r"would expand \d+ bytes to 264; allowed are 100 bytes"):
        read_pcd(whole, FileLimits(max_expanded_bytes=100))
