"""Mesh files of descriptions: where they are looked for, what is read, what is left out or refused."""

import importlib.util

import numpy as np
import pytest
import torch
import trimesh

from torchreg.errors import FormatError, MissingExtraError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.mesh_files import MeshFiles


@pytest.fixture
def folder(tmp_path):
    """A robot's folder, in which box.stl is 1 m, and other/box.stl 2 m wide."""
    (tmp_path / "robot" / "other").mkdir(parents=True)
    for name, size in (("box.stl", 1), ("other/box.stl", 2)):
        trimesh.creation.box(extents=(size, 1, 1)).export(tmp_path / "robot" / name)
    return tmp_path / "robot"


def files(folder, package_dirs=(), require=True, limits=DEFAULT_LIMITS):
    return MeshFiles(folder / "robot.urdf", list(package_dirs), require, limits)


def width(mesh):
    return float(mesh.bounds()[1, 0] - mesh.bounds()[0, 0])


def test_names_are_places_addresses_or_packages(folder, tmp_path):
    found = files(folder)
    for name, size in (
        ("box.stl", 1), ("other/box.stl", 2), ("../robot/box.stl", 1), (f"file://{folder}/other/box.stl", 2),
        (f"file://{folder}/%62ox.stl", 1), ("package://robot/box.stl", 1), ("model://robot/other/box.stl", 2),
    ):  # fmt: skip
        assert width(found.read(name, "a")) == size, name
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    with pytest.raises(FormatError, match=r"a: mesh file 'package://other/box\.stl' was not found \(looked at "):
        files(elsewhere).read("package://other/box.stl", "a")
    for place in (folder, folder / "other"):
        assert width(files(elsewhere, [place]).read("package://other/box.stl", "a")) == 2
    with pytest.raises(FormatError, match="is remote; save it beside the URDF"):
        found.read("https://example.org/ball.stl", "a")


def test_given_folders_come_before_those_above_of_the_same_name(folder, tmp_path):
    mine = tmp_path / "mine" / "robot"
    mine.mkdir(parents=True)
    trimesh.creation.box(extents=(3, 1, 1)).export(mine / "box.stl")
    assert width(files(folder, [mine]).read("package://robot/box.stl", "a")) == 3


def test_a_file_is_read_once(folder):
    found = files(folder)
    mesh = found.read("box.stl", "a")
    (folder / "box.stl").write_bytes(b"damaged since")
    assert found.read("box.stl", "b") is mesh
    assert mesh.vertices.dtype == torch.float64


def test_scenes_are_put_together(folder):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.add_geometry(trimesh.creation.box())
    scene.export(folder / "two.glb")
    mesh = files(folder).read("two.glb", "a")
    assert mesh.num_faces == 24
    np.testing.assert_allclose(mesh.bounds()[:, 0], [-0.5, 3.5], atol=1e-6)


def test_missing_files_are_left_out_if_they_may_be(folder):
    for name in ("gone.stl", "x" * 5000 + ".stl"):
        with pytest.raises(FormatError, match="was not found"):
            files(folder).read(name, "a")
        assert files(folder, require=False).read(name, "a") is None


def test_collada_needs_its_extra(folder, monkeypatch):
    (folder / "box.dae").write_bytes(b"<COLLADA/>")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"a: .*torchreg-articulated\[urdf\]"):
        files(folder).read("box.dae", "a")
    assert files(folder, require=False).read("box.dae", "a") is None


def test_collada_comes_in_metres_and_without_its_looks(folder):
    pytest.importorskip("collada")
    content = trimesh.exchange.dae.export_collada(trimesh.creation.box())
    broken = content.replace(b"<library_effects>", b"<library_effects><effect id='x'><profile_COMMON/></effect>", 1)
    for number, (text, size) in enumerate((
        (content, 1),
        (content.replace(b"<up_axis>", b'<unit name="cm" meter="0.01"/><up_axis>', 1), 0.01),
        (b"\n" + broken.replace(b"#", b"#no", 1), 1),
    )):  # fmt: skip
        (folder / f"{number}.dae").write_bytes(text)
        assert width(files(folder).read(f"{number}.dae", "a")) == pytest.approx(size)
    for text, message in (
        (b'<!DOCTYPE a [<!ENTITY b "c">]>' + content, r"bad\.dae: .*document type"),
        (b"not xml", r"bad\.dae: not a readable dae mesh"),
    ):
        (folder / "bad.dae").write_bytes(text)
        with pytest.raises(FormatError, match=message):
            files(folder).read("bad.dae", "a")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bad.stl", b"solid nothing", r"bad\.stl"),
        ("bad.stl", b"\0" * 80 + b"\xff\xff\xff\x7f" + b"\0" * 50, r"bad\.stl: not a readable stl mesh"),
        ("nan.obj", b"v nan 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n", r"nan\.obj: not a readable obj mesh"),
        ("empty.obj", b"v 0 0 0\n", r"empty\.obj"),
        ("bad.glb", b"glTF", r"bad\.glb: not a readable glb mesh"),
        ("mesh.fbx", b"x", r"meshes of kind '\.fbx' are not read"),
    ],
)
def test_damaged_meshes_are_refused_though_missing_ones_may_be_left_out(folder, name, content, message):
    (folder / name).write_bytes(content)
    for require in (True, False):
        with pytest.raises(FormatError, match=message):
            files(folder, require=require).read(name, "a")


def test_sizes_are_limited(folder):
    with pytest.raises(FormatError, match="the limit is 100"):
        files(folder, limits=FileLimits(max_bytes=100)).read("box.stl", "a")
