"""Whatever happens to a file, the loader answers with a cloud or with one FormatError, soon and within bounds."""

import contextlib
import io
import struct
import time
import tracemalloc

import numpy as np
import pytest
import torch
import trimesh

from torchreg.errors import FormatError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.points import load_points, save_points

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
    with contextlib.suppress(FormatError):
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
    variants = [content[:cut] for cut in rng.integers(0, len(content), 60)]
    for count in (1, 1, 1, 3, 20):
        for _ in range(40):
            damaged = bytearray(content)
            for place in rng.integers(0, len(content), count):
                damaged[place] = rng.choice(
                    [rng.integers(256), damaged[place] ^ (1 << rng.integers(8)), 0, 255, 45, 57]
                )
            variants.append(bytes(damaged))
    for _ in range(30):  # lost or doubled pieces
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
