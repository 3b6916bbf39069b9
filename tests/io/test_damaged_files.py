"""Files that are cut at every place or damaged in any way, limits before anything is read, and what is no file."""

import contextlib
import os
import socket
import struct
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from tests.io.helpers import put
from tests.io.test_binary_clouds import QUAD, pcd, ply, stl, stl_text
from tests.tables import each, refused
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.limits import FileLimits
from torchreg.io.points import save_points

FormatError, FileWarning, InputError = tr.errors.FormatError, tr.errors.FileWarning, tr.errors.InputError
SPHERE = unit_sphere(0, dtype=torch.float64)
# Numbers of bytes at the end of which some may be missing unnoticed: digits of the last number, line ends.
TAILS = {
    "ply0.ply": 1, "ply1.ply": None, "obj2.obj": None, "stl3.stl": 1, "stl_ascii4.stl": 16, "glb5.glb": 1,
    "saved.ply": 1, "saved.pcd": 1, "saved.xyz": None, "saved.npz": 1, "packed.npz": 1, "packed.pcd": 1,
    "text.pcd": None, "text.ply": 3, "little.ply": 0, "big.ply": 0, "ascii.pcd": 20, "binary.pcd": 1,
    "binary_compressed.pcd": 1, "hand.stl": 0, "hand_text.stl": 14,
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    mesh = trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False)
    found = {}
    kinds = [("ply", {}), ("ply", {"encoding": "ascii"}), *((kind, {}) for kind in ("obj", "stl", "stl_ascii", "glb"))]
    for number, (kind, options) in enumerate(kinds):
        content = mesh.export(file_type=kind, **options)
        found[f"{kind}{number}.{kind[:3]}"] = content if isinstance(content, bytes) else content.encode()
    for ending in ("ply", "pcd", "xyz", "npz"):
        path = folder / f"saved.{ending}"
        save_points(path, SPHERE.vertices, SPHERE.vertices, None if ending == "xyz" else (SPHERE.vertices + 1) / 2)
        found[path.name] = path.read_bytes()
    np.savez_compressed(folder / "packed.npz", points=SPHERE.vertices.numpy())
    found["packed.npz"] = (folder / "packed.npz").read_bytes()
    header = b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 12\nHEIGHT 1\nPOINTS 12\nDATA "
    plain = SPHERE.vertices.float().T.contiguous().numpy().tobytes()
    block = b"".join(bytes([len(plain[k : k + 32]) - 1]) + plain[k : k + 32] for k in range(0, len(plain), 32))
    found["packed.pcd"] = header + b"binary_compressed\n" + struct.pack("<II", len(block), len(plain)) + block
    rows = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in SPHERE.vertices.tolist())
    found["text.pcd"] = header + b"ascii\n" + rows.encode()
    found |= {
        f"{name}.ply": ply(form, QUAD)
        for name, form in (("text", "ascii"), ("little", "binary_little_endian"), ("big", "binary_big_endian"))
    }
    found |= {f"{data}.pcd": pcd(data) for data in ("ascii", "binary", "binary_compressed")}
    return found | {"hand.stl": stl(), "hand_text.stl": stl_text().encode()}


def outcome(path, content):
    path.write_bytes(content)
    with contextlib.suppress(FormatError), warnings.catch_warnings():
        warnings.simplefilter("ignore", FileWarning)
        return len(tr.load_points(path, nan_policy="omit"))
    return 0


def test_the_corpus_is_sound(files, tmp_path):
    assert list(files) == list(TAILS)
    for name, content in files.items():
        assert outcome(tmp_path / name, content) in (12, 6, 4), name


@pytest.mark.parametrize("name", [name for name, tail in TAILS.items() if tail is not None])
def test_no_file_that_is_cut_off_passes(files, tmp_path, name):
    content = files[name]
    end = len(content) - TAILS[name]
    for cut in {*range(0, end, max(1, end // 150)), *range(max(0, end - 10), end)}:
        assert outcome(tmp_path / name, content[:cut]) == 0, cut
    if name.endswith(("ply", "pcd", "stl", "glb")):
        assert outcome(tmp_path / name, content + b"\n1 2 3 4 5 6 7 8 9\n") == 0
    if name.endswith("ply"):
        assert outcome(tmp_path / name, content + b"\n") > 0
    if name.startswith("binary"):
        assert outcome(tmp_path / name, content + b"\0\0\n") > 0  # padding to a page


@pytest.mark.filterwarnings("ignore:Reading `.npy` or `.npz` file required additional header parsing:UserWarning")
@pytest.mark.parametrize("name", list(TAILS)[:13])
def test_only_format_errors_escape_and_bounds_hold(files, tmp_path, name):
    content, path = files[name], tmp_path / name
    rng = np.random.default_rng(list(TAILS).index(name))
    variants = []
    for count in (1, 1, 1, 3, 20):
        for _ in range(20):
            damaged = bytearray(content)
            for place in rng.integers(0, len(content), count):
                other = [rng.integers(256), damaged[place] ^ (1 << rng.integers(8)), 0, 255, 45, 57]
                damaged[place] = rng.choice(other)
            variants.append(bytes(damaged))
    for _ in range(15):  # lost or doubled pieces
        begin, end = sorted(rng.integers(0, len(content), 2))
        variants += [content[:begin] + content[end:], content[:end] + content[begin:]]
    outcome(path, content)
    tracemalloc.start()
    try:
        for variant in variants:
            outcome(path, variant)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "word"), [("ply1.ply", b"element vertex 12"), ("text.pcd", b"POINTS 12"), ("ply1.ply", b"element face 20")]
)
@pytest.mark.parametrize("claim", [b"11", b"13", b"2", b"120000000000"])
def test_damaged_header_digits_never_pass_unnoticed(files, tmp_path, name, word, claim):
    assert word in files[name]
    assert outcome(tmp_path / name, files[name].replace(word, word[:-2] + claim)) == 0


@each("http://host/a", "file:///etc/passwd", "s3://bucket/a", "HTTPS://host/a", Path("http://host/a"), "\\\\h\\s")
def test_addresses_are_refused(address):
    refused((lambda: tr.load_points(address), "is an address, not a local file: download it first"))


def test_local_files_are_read_and_what_is_none_is_refused(tmp_path):
    path = put(tmp_path, "a b:c.xyz", "1 2 3\n")
    assert len(tr.load_points(str(path), limits=FileLimits(max_bytes=6))) == 1
    (tmp_path / "link").symlink_to(path)
    assert len(tr.load_points(tmp_path / "link")) == 1
    with (tmp_path / "big").open("wb") as stream:
        stream.truncate(10 * 1024**3)  # sparse: takes no room
    big = rf"big holds {10 * 1024**3} bytes, the limit is {2 * 1024**3}"
    refused(*((lambda name=name: tr.load_points(tmp_path / name), "missing") for name in ("missing", "missing.xyz")),
            (lambda: tr.load_points("C:/scans/missing.xyz"), "missing"), error=FileNotFoundError)  # fmt: skip
    refused((lambda: tr.load_points(tmp_path), "is a folder"), error=IsADirectoryError)
    refused(
        (lambda: tr.load_points(""), "not the name of"),
        (lambda: tr.load_points("a\0b"), "not the name of a file"),
        (lambda: tr.load_points(path, limits=FileLimits(max_bytes=5)), "limit is 5"),
        (lambda: tr.load_points(tmp_path / "big"), big),
    )
    words = r"path must be a str or a pathlib\.Path"
    refused(*((lambda v=v: tr.load_points(v), words) for v in (3, b"bytes", None)), error=tr.errors.InputTypeError)


@pytest.mark.skipif(os.name != "posix", reason="pipes and devices of POSIX")
def test_pipes_devices_and_sockets_are_refused_without_waiting(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        refused(
            *(
                (lambda name=name: tr.load_points(name), "is not a regular file")
                for name in ("pipe", "/dev/zero", "socket")
            )
        )


@pytest.mark.parametrize("name", ["max_bytes", "max_points", "max_faces", "max_zip_ratio", "max_expanded_bytes"])
@pytest.mark.parametrize("value", [0, -1, float("nan"), "5", True])
def test_limits_must_be_positive(name, value):
    with pytest.raises(InputError, match=f"{name} must be a positive number"):
        FileLimits(**{name: value})
