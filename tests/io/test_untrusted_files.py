"""Bounds that are checked before a file is read or expanded, and files that are damaged in any way."""

import contextlib
import io
import os
import socket
import struct
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchreg.errors import FileWarning, FormatError, InputError, InputTypeError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_allowed, local_path, open_zip, read_bytes
from torchreg.io.points import load_points, save_points
from torchreg.io.strict_xml import parse_xml


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
    check_allowed(DEFAULT_LIMITS.max_points, "points", DEFAULT_LIMITS)
    check_allowed(DEFAULT_LIMITS.max_points + 1, "faces", DEFAULT_LIMITS)
    with pytest.raises(FormatError, match=r"claims 6 points, allowed are 0 to 5; .* FileLimits\(max_points=\.\.\.\)"):
        check_allowed(6, "points", FileLimits(max_points=5))
    with pytest.raises(FormatError, match="claims -1 faces"):
        check_allowed(-1, "faces", DEFAULT_LIMITS)


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


def test_elements_come_as_they_stand():
    root = parse_xml(b"\n <?xml version='1.0'?><a x='1'>t<b/><!-- c --><b y='&lt;'/></a>")
    assert (root.tag, root.attrib, root.text) == ("a", {"x": "1"}, "t")
    assert [child.attrib for child in root] == [{}, {"y": "<"}]


def test_other_encodings_are_read():
    assert parse_xml("<?xml version='1.0' encoding='utf-16'?><a x='ü'/>".encode("utf-16")).get("x") == "ü"


def test_nesting_is_limited_in_depth_not_in_number():
    assert len(parse_xml(b"<a>" + b"<b></b>" * 500 + b"</a>")) == 500
    parse_xml(b"<a>" * 64 + b"</a>" * 64)
    with pytest.raises(FormatError, match="nests elements more than 64 deep"):
        parse_xml(b"<a>" * 65 + b"</a>" * 65)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not well-formed XML"),
        (b"<a>", "not well-formed XML"),
        (b"<a></b>", "not well-formed XML"),
        (b"<?xml version='1.0' encoding='klingon'?><a/>", "not well-formed XML"),
        (b"<a>\xff</a>", "not well-formed XML"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", r"document type declaration \('a'\)"),
        (b"<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>", "document type declaration"),
    ],
)
def test_what_is_refused(content, message):
    with pytest.raises(FormatError, match=message):
        parse_xml(content)


SPHERE = unit_sphere(0, dtype=torch.float64)


def corpus(folder) -> dict[str, bytes]:
    mesh = trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False)
    files = {}
    for kind, options in (
        ("ply", {}),
        ("ply", {"encoding": "ascii"}),
        ("obj", {}),
        ("stl", {}),
        ("stl_ascii", {}),
        ("glb", {}),
    ):
        content = mesh.export(file_type=kind, **options)
        files[f"{kind}{len(files)}.{kind[:3]}"] = content if isinstance(content, bytes) else content.encode()
    for ending in ("ply", "pcd", "xyz", "npz"):
        path = folder / f"saved.{ending}"
        save_points(path, SPHERE.vertices, SPHERE.vertices, None if ending == "xyz" else (SPHERE.vertices + 1) / 2)
        files[path.name] = path.read_bytes()
    stream = io.BytesIO()
    np.savez_compressed(stream, points=SPHERE.vertices.numpy())
    files["packed.npz"] = stream.getvalue()
    header = files["saved.pcd"].split(b"DATA")[0].replace(b"FIELDS", b"#").replace(b"SIZE", b"#").replace(b"TYPE", b"#")
    header = header.replace(b"COUNT", b"#") + b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
    plain = SPHERE.vertices.float().T.contiguous().numpy().tobytes()
    block = b"".join(bytes([len(plain[k : k + 32]) - 1]) + plain[k : k + 32] for k in range(0, len(plain), 32))
    files["packed.pcd"] = header + b"DATA binary_compressed\n" + struct.pack("<II", len(block), len(plain)) + block
    files["text.pcd"] = (
        header + b"DATA ascii\n" + "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in SPHERE.vertices.tolist()).encode()
    )
    return files


NAMES = [
    "ply0.ply", "ply1.ply", "obj2.obj", "stl3.stl", "stl_ascii4.stl", "glb5.glb", "saved.ply", "saved.pcd", "saved.xyz",
    "saved.npz", "packed.npz", "packed.pcd", "text.pcd",
]  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return corpus(tmp_path_factory.mktemp("corpus"))


def outcome(path, content: bytes) -> int:
    path.write_bytes(content)
    with contextlib.suppress(FormatError), warnings.catch_warnings():
        warnings.simplefilter("ignore", FileWarning)
        return len(load_points(path, nan_policy="omit"))
    return 0


def test_the_corpus_is_sound(files, tmp_path):
    assert list(files) == NAMES
    for name, content in files.items():
        assert outcome(tmp_path / name, content) == 12, name


@pytest.mark.filterwarnings("ignore:Reading `.npy` or `.npz` file required additional header parsing:UserWarning")
@pytest.mark.parametrize("name", NAMES)
def test_only_format_errors_escape_and_bounds_hold(files, tmp_path, name):
    content, path = files[name], tmp_path / name
    rng = np.random.default_rng(NAMES.index(name))
    variants = [content[:cut] for cut in rng.integers(0, len(content), 30)]
    for count in (1, 1, 1, 3, 20):
        for _ in range(20):
            damaged = bytearray(content)
            for place in rng.integers(0, len(content), count):
                damaged[place] = rng.choice(
                    [rng.integers(256), damaged[place] ^ (1 << rng.integers(8)), 0, 255, 45, 57]
                )
            variants.append(bytes(damaged))
    for _ in range(15):  # lost or doubled pieces
        begin, end = sorted(rng.integers(0, len(content), 2))
        variants += [content[:begin] + content[end:], content[:end] + content[begin:]]
    outcome(path, content)
    tracemalloc.start()
    started = time.perf_counter()
    try:
        for variant in variants:
            outcome(path, variant)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - started < 60


@pytest.mark.parametrize(
    "name", ["ply0.ply", "stl3.stl", "glb5.glb", "saved.ply", "saved.pcd", "saved.npz", "packed.pcd"]
)
def test_no_truncated_binary_file_passes(files, tmp_path, name):
    content = files[name]
    for cut in range(0, len(content) - 1, 5):
        assert outcome(tmp_path / name, content[:cut]) == 0, cut


def test_damaged_header_digits_never_pass_unnoticed(files, tmp_path):
    for name, word in (
        ("ply1.ply", b"element vertex 12"),
        ("text.pcd", b"POINTS 12"),
        ("ply1.ply", b"element face 20"),
    ):
        assert word in files[name]
        for claim in (b"11", b"13", b"2", b"120000000000"):
            changed = files[name].replace(word, word[:-2] + claim)
            assert outcome(tmp_path / name, changed) == 0, (name, claim)
