"""Robot descriptions: numbers, order, limits, mimic joints, geometry and everything that is refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.errors import FileWarning, FormatError, InputError, ModelError
from torchreg.io.limits import FILE_BUDGET, FileLimits
from torchreg.io.urdf import load_urdf

ARM = """<?xml version="1.0" encoding="utf-8"?>
<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro">
  <joint name="wrist" type="prismatic">
    <parent link="lower"/><child link="hand"/><origin xyz="0 0 0.3"/><axis xyz="0 0 2"/>
    <limit lower="-0.1" upper="0.2" effort="1" velocity="1"/>
  </joint>
  <link name="hand"><visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual></link>
  <link name="lower">
    <visual>
      <origin xyz="0 0 0.1" rpy="0 1.5707963267948966 0"/><geometry><cylinder radius="0.02" length="0.2"/></geometry>
    </visual>
  </link>
  <link name="base"/>
  <joint name="shoulder" type="continuous">
    <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><parent link="base"/><child link="upper"/><axis xyz="1 1 0"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/><limit effort="1" lower="-1" upper="2" velocity="3"/>
  </joint>
  <link name="upper"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <transmission name="t"><joint name="elbow"/></transmission>
</robot>
"""


def write(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def robot(*parts: str) -> str:
    return f"<robot name='r'>{''.join(parts)}</robot>"


def joint(name: str, parent: str, child: str, kind: str = "revolute", body: str = "") -> str:
    return f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{body}</joint>"


def links(*names: str) -> str:
    return "".join(f"<link name='{name}'/>" for name in names)


def with_mesh(filename: str, attributes: str = "", origin: str = "") -> str:
    shape = f"<geometry><mesh filename='{filename}' {attributes}/></geometry>"
    return robot(f"<link name='a'><visual>{origin}{shape}</visual></link>")


def test_tree_is_in_order_with_exact_numbers(tmp_path: Path) -> None:
    record = load_urdf(write(tmp_path, ARM))
    assert record.name == "arm"
    assert record.link_names == ("base", "upper", "lower", "hand")
    assert [frame.name for frame in record.tree.joints] == ["base", "shoulder", "elbow", "wrist"]
    assert [frame.parent for frame in record.tree.joints] == [-1, 0, 1, 2]
    assert [frame.kind for frame in record.tree.joints] == ["fixed", "revolute", "revolute", "prismatic"]
    shoulder, elbow, wrist = record.tree.joints[1:]
    assert (shoulder.lower, shoulder.upper) == (-math.inf, math.inf)
    assert (elbow.lower, elbow.upper, elbow.axis) == (-1, 2, (1, 0, 0))
    assert (wrist.lower, wrist.upper, wrist.axis) == (-0.1, 0.2, (0, 0, 1))
    assert shoulder.axis == pytest.approx((0.5**0.5, 0.5**0.5, 0), abs=1e-15)
    assert shoulder.offset.dtype == torch.float64
    assert shoulder.offset[:3, 3].tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_allclose(
        shoulder.offset[:3, :3], Rotation.from_euler("xyz", [0.4, -0.5, 0.6]).as_matrix(), atol=1e-15
    )


def test_primitives_have_size_and_place(tmp_path: Path) -> None:
    record = load_urdf(write(tmp_path, ARM))
    base, upper, lower, hand = record.link_primitives
    assert base == ()
    assert (upper[0].kind, upper[0].size) == ("sphere", (0.05,))
    assert (hand[0].kind, hand[0].size) == ("box", (0.1, 0.2, 0.3))
    assert (lower[0].kind, lower[0].size) == ("cylinder", (0.02, 0.2))
    # The cylinder's axis is turned from z to x.
    np.testing.assert_allclose(lower[0].origin @ torch.tensor([0.0, 0, 1, 1]).double(), [1, 0, 0.1, 1], atol=1e-15)
    assert record.link_meshes == (None,) * 4


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_origins_agree_with_scipy(tmp_path_factory: pytest.TempPathFactory, rpy: list[float]) -> None:
    folder = tmp_path_factory.mktemp("origin")
    body = f"<origin rpy='{' '.join(repr(a) for a in rpy)}'/>"
    record = load_urdf(write(folder, robot(links("a", "b"), joint("j", "a", "b", "fixed", body))))
    rotation = record.tree.joints[1].offset[:3, :3]
    np.testing.assert_allclose(rotation, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-13)


def test_deep_chain_and_backward_order(tmp_path: Path) -> None:
    count = 1500
    joints = "".join(joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in reversed(range(count - 1)))
    record = load_urdf(write(tmp_path, robot(joints, links(*(f"l{i}" for i in reversed(range(count)))))))
    assert [frame.parent for frame in record.tree.joints] == list(range(-1, count - 1))


def test_mimic_chains_follow_the_moving_joint(tmp_path: Path) -> None:
    text = robot(
        links("a", "b", "c", "d"),
        joint("third", "a", "d", body="<mimic joint='second' multiplier='-2' offset='0.5'/>"),
        joint("second", "a", "c", body="<mimic joint='first' multiplier='3' offset='0.25'/>"),
        joint("first", "a", "b"),
    )
    tree = load_urdf(write(tmp_path, text)).tree
    first, second, third = (tree.joints[tree.index(name)] for name in ("first", "second", "third"))
    assert first.mimic is None
    assert second.mimic == (tree.index("first"), 3, 0.25)
    # third = -2 (3 x + 0.25) + 0.5
    assert third.mimic == (tree.index("first"), -6, 0)


def test_limits_that_are_incomplete(tmp_path: Path) -> None:
    text = robot(
        links("a", "b", "c", "d"),
        joint("none", "a", "b"),
        joint("effort_only", "a", "c", body="<limit effort='1' velocity='1'/>"),
        joint("upper_only", "a", "d", body="<limit upper='1'/>"),
    )
    tree = load_urdf(write(tmp_path, text)).tree
    assert [(frame.lower, frame.upper) for frame in tree.joints[1:]] == [(-math.inf, math.inf)] * 2 + [(0, 1)]


def test_root_named_like_a_joint(tmp_path: Path) -> None:
    record = load_urdf(write(tmp_path, robot(links("base", "tip"), joint("base", "base", "tip"))))
    assert [frame.name for frame in record.tree.joints] == ["base_root", "base"]
    assert record.link_names == ("base", "tip")


def test_mesh_is_scaled_then_placed(tmp_path: Path) -> None:
    box = trimesh.creation.box(extents=(1, 2, 3))
    box.export(tmp_path / "box.STL")
    origin = "<origin xyz='1 0 0' rpy='0 0 1.5707963267948966'/>"
    mesh = load_urdf(write(tmp_path, with_mesh("box.STL", "scale='1 1 0.5'", origin))).link_meshes[0]
    assert mesh is not None
    assert mesh.vertices.dtype == torch.float64
    np.testing.assert_allclose(mesh.bounds(), [[0, -0.5, -0.75], [2, 0.5, 0.75]], atol=1e-7)
    volume = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy()).volume
    assert volume == pytest.approx(3, abs=1e-6)


def test_mirrored_mesh_keeps_its_outside(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(1, 2, 3)).export(tmp_path / "box.obj")
    mesh = load_urdf(write(tmp_path, with_mesh("box.obj", "scale='1 -1 1'"))).link_meshes[0]
    assert mesh is not None
    assert trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy()).volume == pytest.approx(6, abs=1e-6)


def test_visuals_are_concatenated_and_collision_stands_in(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "box.stl")
    shape = "<geometry><mesh filename='box.stl'/></geometry>"
    text = robot(
        f"<link name='a'><visual>{shape}</visual><visual><origin xyz='5 0 0'/>{shape}</visual>"
        f"<visual><geometry><capsule radius='1' length='2'/></geometry></visual></link>",
        f"<link name='b'><visual/><collision>{shape}</collision></link>",
        joint("j", "a", "b"),
    )
    record = load_urdf(write(tmp_path, text))
    first, second = record.link_meshes
    assert first is not None
    assert second is not None
    assert (first.num_faces, second.num_faces) == (24, 12)
    assert float(first.bounds()[1, 0]) == pytest.approx(5.5)
    assert record.link_primitives[0][0].size == (1, 2)


@pytest.mark.parametrize("scheme", ["package", "model"])
def test_packages_are_found(tmp_path: Path, scheme: str) -> None:
    above = tmp_path / "my_robot"
    (above / "urdf").mkdir(parents=True)
    (above / "meshes").mkdir()
    trimesh.creation.box().export(above / "meshes" / "box.stl")
    address = f"{scheme}://my_robot/meshes/box.stl"
    assert load_urdf(write(above / "urdf", with_mesh(address))).link_meshes[0] is not None
    (tmp_path / "elsewhere").mkdir()
    outside = write(tmp_path / "elsewhere", with_mesh(address))
    assert load_urdf(outside, package_dirs=[above]).link_meshes[0] is not None
    assert load_urdf(outside, package_dirs=[tmp_path]).link_meshes[0] is not None


def test_missing_mesh_is_named_or_skipped(tmp_path: Path) -> None:
    path = write(tmp_path, with_mesh("gone.stl"))
    with pytest.raises(FormatError, match=r"visual of link 'a'.*'gone\.stl' was not found"):
        load_urdf(path, meshes="require")
    with pytest.warns(FileWarning, match=r"'gone\.stl' was not found .*package_dirs=; it is left out"):
        assert load_urdf(path).link_meshes == (None,)
    assert load_urdf(path, meshes="skip").link_meshes == (None,)
    with pytest.raises(InputError, match="meshes must be one of warn, require, skip"):
        load_urdf(path, meshes="maybe")
    with pytest.raises(FormatError, match="was not found"):
        load_urdf(write(tmp_path, with_mesh("x" * 5000 + ".stl")), meshes="require")


def test_mesh_requests_that_are_refused(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "box.stl")
    for text, message in (
        (with_mesh("https://example.org/ball.stl"), "is remote"),
        (with_mesh(""), "its <mesh> has no filename"),
        (with_mesh("box.stl", "scale='0 1 1'"), "scale of zero"),
    ):
        with pytest.warns(FileWarning, match=message):
            assert load_urdf(write(tmp_path, text)).link_meshes == (None,)
    with pytest.raises(FormatError, match="36 vertices"):
        load_urdf(write(tmp_path, with_mesh("box.stl")), limits=FileLimits(max_points=10))


PAIR = links("a", "b")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (robot(), "1 to 2000 links, got 0"),
        (robot(*(links(f"l{i}") for i in range(2001))), "1 to 2000 links, got 2001"),
        (robot(links("a", "a")), "two links are called 'a'"),
        (robot("<link/>"), "link number 0 has no name"),
        (robot(links("a", "b", "c"), joint("j", "a", "b"), joint("j", "a", "c")), "two joints are called 'j'"),
        (robot(links("a", "b")), "disconnected, 2 links have no parent: a, b"),
        (robot(PAIR, joint("j", "a", "b"), joint("k", "b", "a")), "cycle through links a, b"),
        (robot(links("r"), PAIR, joint("j", "a", "b"), joint("k", "b", "a")), "cycle through links a, b"),
        (robot(PAIR, joint("j", "a", "a")), "disconnected|cycle"),
        (
            robot(PAIR, joint("j", "a", "b"), joint("k", "a", "b")),
            "'b' has two parents, joints 'j' and 'k': a closed loop is no tree; leave one",
        ),
        (robot(PAIR, joint("j", "a", "z")), "joint 'j' has child link 'z'"),
        (robot(PAIR, "<joint name='j' type='fixed'><child link='b'/></joint>"), "joint 'j' has parent link None"),
        (robot(PAIR, joint("j", "a", "b", "helical")), "joint 'j' is of type 'helical'; supported: revolute"),
        (robot(PAIR, joint("j", "a", "b", body="<axis xyz='0 0 0'/>")), "joint 'j' has a zero axis"),
        (robot(PAIR, joint("j", "a", "b", body="<origin xyz='0 nan 0'/>")), "joint 'j': xyz='0 nan 0'.*not finite"),
        (robot(PAIR, joint("j", "a", "b", body="<origin rpy='inf 0 0'/>")), "not finite"),
        (robot(PAIR, joint("j", "a", "b", body="<limit lower='2' upper='1'/>")), "joint 'j' has limits 2.0 to 1.0"),
        (robot(PAIR, joint("j", "a", "b", body="<mimic joint='z'/>")), "mimics joint 'z', which the file does not"),
        (robot(PAIR, joint("j", "a", "b", body="<mimic joint='j'/>")), "mimics joint 'j' in a cycle"),
        (
            robot(links("a", "b", "c"), joint("f", "a", "b", "fixed"), joint("j", "b", "c", body="<mimic joint='f'/>")),
            "mimics joint 'f', which is fixed",
        ),
    ],
)
def test_impossible_robots(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        load_urdf(write(tmp_path, text))
    assert "robot.urdf" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed XML"),
        ("<robot>", "not well-formed XML"),
        ("<?xml version='1.0' encoding='klingon'?><robot/>", "not well-formed XML"),
        ("<sdf/>", "must be <robot>, got <sdf>"),
        ("<!DOCTYPE robot [<!ENTITY a 'b'>]><robot>&a;</robot>", "document type declaration"),
        ("<!DOCTYPE robot SYSTEM 'file:///etc/passwd'><robot/>", "document type declaration"),
        ("<robot>" + "<a>" * 100 + "</a>" * 100 + "</robot>", "more than 64 deep"),
        ("<robot><xacro:macro/></robot>", "expand them first"),
        ("<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:macro name='m'/></robot>", "expand them first"),
        ("<robot><link name='${prefix}a'/></robot>", "expand them first"),
        (robot(PAIR, joint("j", "a", "b", body="<origin xyz='1 2'/>")), "must hold 3"),
        (robot(PAIR, joint("j", "a", "b", body="<origin xyz='1 2 x'/>")), "not a list of numbers"),
    ],
)
def test_damaged_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message) as caught:
        load_urdf(write(tmp_path, text))
    assert "robot.urdf" in str(caught.value)


def test_size_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, ARM)
    with pytest.raises(FormatError, match="the limit is 100"):
        load_urdf(path, limits=FileLimits(max_bytes=100))
    monkeypatch.setattr("torchreg.io.urdf.FILE_BUDGET", replace(FILE_BUDGET, xml_bytes=100))
    with pytest.raises(FormatError, match="bytes of XML"):
        load_urdf(path)


def test_other_encodings_are_read(tmp_path: Path) -> None:
    text = "<?xml version='1.0' encoding='utf-16'?>" + robot("<link name='Gelenk-ü'/>")
    path = tmp_path / "robot.urdf"
    path.write_bytes(text.encode("utf-16"))
    assert load_urdf(path).link_names == ("Gelenk-ü",)


def test_colors_of_links_are_those_of_their_first_visual_with_one(tmp_path: Path) -> None:
    def link(name: str, *materials: str) -> str:
        box = "<geometry><box size='1 1 1'/></geometry>"
        return f"<link name='{name}'>{''.join(f'<visual>{box}{inner}</visual>' for inner in materials)}</link>"

    red = "<material name='m'><color rgba='1 0 0 1'/></material>"
    text = robot(
        "<material name='green'><color rgba='0 1 0 0.5'/></material>",
        link("a", "<material name='none'/>", "<material name='green'/>"),
        link("b", red),
        link("c", "<material name='x'><color rgba='9 0 0 1'/></material>"),
        link("d", "<material><color rgba='red'/></material>"),
        *(joint(f"j{child}", "a", child, "fixed") for child in "bcd"),
    )
    assert load_urdf(write(tmp_path, text)).link_colors == ((0, 1, 0), (1, 0, 0), None, None)
