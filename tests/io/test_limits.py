"""Bounds that are looked at before a file is read or expanded."""

import io
import os
import socket
import zipfile
from pathlib import Path

import numpy as np
import pytest

from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_count, local_path, open_zip, read_bytes


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def test_reads_what_is_there(tmp_path):
    path = tmp_path / "a b:c.bin"
    path.write_bytes(b"content")
    assert read_bytes(path) == b"content"
    assert read_bytes(str(path), FileLimits(max_bytes=7)) == b"content"
    (tmp_path / "link").symlink_to(path)
    assert read_bytes(tmp_path / "link") == b"content"


@pytest.mark.parametrize(
    "address",
    [
        "http://host/a.ply",
        "file:///etc/passwd",
        "s3://bucket/a.ply",
        "HTTPS://host/a",
        Path("http://host/a.ply"),
        "\\\\h\\s",
    ],
)
def test_addresses_are_refused(address):
    with pytest.raises(FormatError, match="is an address, not a local file: download it first"):
        read_bytes(address)


def test_drives_and_colons_are_local():
    assert local_path("C:/scans/a.ply") == Path("C:/scans/a.ply")
    assert local_path("scan:1.ply") == Path("scan:1.ply")


def test_what_is_not_a_file_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "missing")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        read_bytes(tmp_path)
    for name in ("", "a\0b"):
        with pytest.raises(FormatError, match="not the name of a file"):
            read_bytes(name)
    for value in (3, b"bytes", None):
        with pytest.raises(InputTypeError, match=r"path must be a str or a pathlib\.Path"):
            read_bytes(value)


@pytest.mark.skipif(os.name != "posix", reason="pipes and devices of POSIX")
def test_pipes_devices_and_sockets_are_refused_without_waiting(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        for path in (tmp_path / "pipe", "/dev/zero", "socket"):
            with pytest.raises(FormatError, match="is not a regular file"):
                read_bytes(path)


def test_size_is_checked_before_reading(tmp_path):
    path = tmp_path / "big"
    with path.open("wb") as stream:
        stream.truncate(10 * 1024**3)  # sparse: takes no room
    with pytest.raises(FormatError, match=rf"big holds {10 * 1024**3} bytes, the limit is {2 * 1024**3}"):
        read_bytes(path)


@pytest.mark.parametrize("name", ["max_bytes", "max_points", "max_faces", "max_zip_ratio", "max_expanded_bytes"])
def test_limits_must_be_positive(name):
    for value in (0, -1, float("nan"), "5", True):
        with pytest.raises(InputError, match=f"{name} must be a positive number"):
            FileLimits(**{name: value})


def test_counts():
    check_count(DEFAULT_LIMITS.max_points, "points", DEFAULT_LIMITS)
    check_count(DEFAULT_LIMITS.max_points + 1, "faces", DEFAULT_LIMITS)
    with pytest.raises(FormatError, match=r"claims 6 points, allowed are 0 to 5; .* FileLimits\(max_points=\.\.\.\)"):
        check_count(6, "points", FileLimits(max_points=5))
    with pytest.raises(FormatError, match="claims -1 faces"):
        check_count(-1, "faces", DEFAULT_LIMITS)


def test_zip_is_opened_when_it_is_reasonable():
    noise = np.random.default_rng(0).bytes(1000)
    with open_zip(zipped({"a": noise, "b": b"0" * 5000})) as archive:
        assert archive.read("a") == noise


def test_zip_bombs_are_refused_before_expanding():
    bomb = zipped({"a.npy": b"\0" * 30_000_000})
    with pytest.raises(FormatError, match=r"would expand \d+ bytes to 30000000; .* 200-fold"):
        open_zip(bomb)
    open_zip(bomb, FileLimits(max_zip_ratio=2000.0)).close()
    with pytest.raises(FormatError, match="allowed are 1000 bytes"):
        open_zip(zipped({"a": b"0123456789" * 101}, zipfile.ZIP_STORED), FileLimits(max_expanded_bytes=1000))


def test_odd_zips_are_refused():
    with pytest.raises(FormatError, match="not a readable zip archive"):
        open_zip(b"no zip at all")
    with pytest.raises(FormatError, match="several members of one name"):
        open_zip(zipped({"one": b"1", "two": b"2"}).replace(b"two", b"one"))
    with pytest.raises(FormatError, match="is packed by method 12; use deflate"):
        open_zip(zipped({"a": b"1"}, zipfile.ZIP_BZIP2))
    encrypted = bytearray(zipped({"a": b"1"}))
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    with pytest.raises(FormatError, match="'a' is encrypted"):
        open_zip(bytes(encrypted))
