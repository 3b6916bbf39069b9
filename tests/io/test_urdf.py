"""Robot descriptions: numbers, order, limits, mimic joints, geometry, meshes, and everything that is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.io.helpers import put
from tests.tables import refused, refusing
from torchreg.io.limits import FILE_BUDGET, FileLimits
from torchreg.io.urdf import load_urdf
from torchreg.io.urdf_file import mesh_files

FileWarning, FormatError, ModelError = tr.errors.FileWarning, tr.errors.FormatError, tr.errors.ModelError
BOX = "<box size='0.1 0.08 0.4'/>"

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


def robot(*parts, head="<robot name='r'>", end="</robot>"):
    return "\n".join([head, *parts, end])


def joint(name, parent, child, kind="revolute", body=""):
    return f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{body}</joint>"


def links(*names):
    return "".join(f"<link name='{name}'/>" for name in names)


def link(name, shape=BOX, tag="visual", origin="<origin xyz='0 0 0.2'/>"):
    return f"<link name='{name}'><{tag}>{origin}<geometry>{shape}</geometry></{tag}></link>"


def with_mesh(filename, attributes="", origin=""):
    return robot(link("a", f"<mesh filename='{filename}' {attributes}/>", origin=origin))


def load(folder, text, **options):
    return load_urdf(put(folder, "robot.urdf", text), **options)


def test_tree_is_in_order_with_exact_numbers(tmp_path):
    record = load(tmp_path, ARM)
    assert (record.name, record.link_names) == ("arm", ("base", "upper", "lower", "hand"))
    joints = record.tree.joints
    assert [(frame.name, frame.parent, frame.kind, frame.lower, frame.upper) for frame in joints[1:]] == [
        ("shoulder", 0, "revolute", -math.inf, math.inf), ("elbow", 1, "revolute", -1, 2),
        ("wrist", 2, "prismatic", -0.1, 0.2),
    ]  # fmt: skip
    assert (joints[2].axis, joints[3].axis) == ((1, 0, 0), (0, 0, 1))
    assert joints[1].axis == pytest.approx((0.5**0.5, 0.5**0.5, 0), abs=1e-15)
    assert joints[1].offset[:3, 3].tolist() == [0.1, 0.2, 0.3]
    base, upper, lower, hand = record.link_primitives
    assert base == ()
    assert [(part[0].kind, part[0].size) for part in (upper, lower, hand)] == [
        ("sphere", (0.05,)), ("cylinder", (0.02, 0.2)), ("box", (0.1, 0.2, 0.3)),
    ]  # fmt: skip
    # The cylinder's axis is turned from z to x.
    np.testing.assert_allclose(lower[0].origin @ torch.tensor([0.0, 0, 1, 1]).double(), [1, 0, 0.1, 1], atol=1e-15)
    assert record.link_meshes == (None,) * 4


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_origins_agree_with_scipy(tmp_path_factory, rpy):
    body = f"<origin rpy='{' '.join(repr(a) for a in rpy)}'/>"
    record = load(tmp_path_factory.mktemp("origin"), robot(links("a", "b"), joint("j", "a", "b", "fixed", body)))
    rotation = record.tree.joints[1].offset[:3, :3]
    np.testing.assert_allclose(rotation, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-13)


def test_deep_chains_of_links_and_of_mimic_joints_take_time_in_proportion(tmp_path):
    count = 1500
    joints = "".join(joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in reversed(range(count - 1)))
    record = load(tmp_path, robot(joints, links(*(f"l{i}" for i in reversed(range(count))))))
    assert [frame.parent for frame in record.tree.joints] == list(range(-1, count - 1))
    mimics = [f"<mimic joint='j{k + 1}' multiplier='-1' offset='0.5'/>" for k in range(count - 1)]
    joints = [joint(f"j{k}", "l0", f"l{k + 1}", body=body) for k, body in enumerate([*mimics, ""])]
    tree = load(tmp_path, robot(links(*(f"l{k}" for k in range(count + 1))), *joints)).tree
    by_name, last = {frame.name: frame for frame in tree.joints}, tree.index(f"j{count - 1}")
    assert by_name["j0"].mimic == (last, -1.0, 0.5)
    assert by_name["j1"].mimic == (last, 1.0, 0.0)


def test_mimic_joints_and_limits_that_are_incomplete(tmp_path):
    text = robot(
        links(*"abcdefg"),
        joint("third", "a", "d", body="<mimic joint='second' multiplier='-2' offset='0.5'/>"),
        joint("second", "a", "c", body="<mimic joint='first' multiplier='3' offset='0.25'/>"),
        joint("first", "a", "b"),
        joint("effort_only", "a", "e", body="<limit effort='1' velocity='1'/>"),
        joint("upper_only", "a", "f", body="<limit upper='1'/>"),
        joint("a", "a", "g"),
    )
    record = load(tmp_path, text)
    tree = record.tree
    by_name = {frame.name: frame for frame in tree.joints}
    first = tree.index("first")
    # third = -2 (3 x + 0.25) + 0.5
    assert [by_name[name].mimic for name in ("first", "second", "third")] == [None, (first, 3, 0.25), (first, -6, 0)]
    limits = [(by_name[name].lower, by_name[name].upper) for name in ("first", "effort_only", "upper_only")]
    assert limits == [(-math.inf, math.inf)] * 2 + [(0, 1)]
    assert (tree.joints[0].name, record.link_names[0]) == ("a_root", "a")  # a joint has the root's name


def test_meshes_are_scaled_then_placed_and_mirrored_ones_keep_their_outside(tmp_path):
    for name in ("box.STL", "box.obj"):
        trimesh.creation.box(extents=(1, 2, 3)).export(tmp_path / name)
    origin = "<origin xyz='1 0 0' rpy='0 0 1.5707963267948966'/>"
    (placed,) = load(tmp_path, with_mesh("box.STL", "scale='1 1 0.5'", origin)).link_meshes
    (mirrored,) = load(tmp_path, with_mesh("box.obj", "scale='1 -1 1'")).link_meshes
    assert placed.vertices.dtype == torch.float64
    np.testing.assert_allclose(placed.bounds(), [[0, -0.5, -0.75], [2, 0.5, 0.75]], atol=1e-7)
    for mesh, volume in ((placed, 3), (mirrored, 6)):
        assert trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy()).volume == pytest.approx(volume, abs=1e-6)


def test_visuals_are_concatenated_and_collision_stands_in(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.stl")
    shape = "<geometry><mesh filename='box.stl'/></geometry>"
    text = robot(
        f"<link name='a'><visual>{shape}</visual><visual><origin xyz='5 0 0'/>{shape}</visual>"
        f"<visual><geometry><capsule radius='1' length='2'/></geometry></visual></link>",
        f"<link name='b'><visual/><collision>{shape}</collision></link>",
        joint("j", "a", "b"),
    )
    record = load(tmp_path, text)
    first, second = record.link_meshes
    assert (first.num_faces, second.num_faces) == (24, 12)
    assert float(first.bounds()[1, 0]) == pytest.approx(5.5)
    assert record.link_primitives[0][0].size == (1, 2)


def test_colors_of_links_are_those_of_their_first_visual_with_one(tmp_path):
    def colored(name, *materials):
        box = "<geometry><box size='1 1 1'/></geometry>"
        return f"<link name='{name}'>{''.join(f'<visual>{box}{inner}</visual>' for inner in materials)}</link>"

    text = robot(
        "<material name='green'><color rgba='0 1 0 0.5'/></material>",
        colored("a", "<material name='none'/>", "<material name='green'/>"),
        colored("b", "<material name='m'><color rgba='1 0 0 1'/></material>"),
        colored("c", "<material name='x'><color rgba='9 0 0 1'/></material>"),
        colored("d", "<material><color rgba='red'/></material>"),
        *(joint(f"j{child}", "a", child, "fixed") for child in "bcd"),
    )
    assert load(tmp_path, text).link_colors == ((0, 1, 0), (1, 0, 0), None, None)


PAIR = links("a", "b")


def pair(body="", kind="revolute"):
    return robot(PAIR, joint("j", "a", "b", kind, body))


FIXED = joint("f", "a", "b", "fixed") + joint("j", "b", "c", body="<mimic joint='f'/>")
test_impossible_robots = refusing(load, ModelError, file="robot.urdf")(
    (robot(), "1 to 2000 links, got 0"),
    (robot(*(links(f"l{i}") for i in range(2001))), "1 to 2000 links, got 2001"),
    (robot(links("a", "a")), "two links are called 'a'"),
    (robot("<link/>"), "link number 0 has no name"),
    (robot(links("a", "b", "c"), joint("j", "a", "b"), joint("j", "a", "c")), "two joints are called 'j'"),
    (robot(PAIR), "disconnected, 2 links have no parent: a, b"),
    (robot(PAIR, joint("j", "a", "b"), joint("k", "b", "a")), "cycle through links a, b"),
    (robot(links("r"), PAIR, joint("j", "a", "b"), joint("k", "b", "a")), "cycle through links a, b"),
    (robot(PAIR, joint("j", "a", "a")), "disconnected|cycle"),
    (robot(PAIR, joint("j", "a", "b"), joint("k", "a", "b")),
     "'b' has two parents, joints 'j' and 'k': a closed loop is no tree; leave one"),
    (robot(PAIR, joint("j", "a", "z")), "joint 'j' has child link 'z'"),
    (robot(PAIR, "<joint name='j' type='fixed'><child link='b'/></joint>"), "joint 'j' has parent link None"),
    (pair(kind="helical"), "joint 'j' is of type 'helical'; supported: revolute"),
    (pair("<axis xyz='0 0 0'/>"), "joint 'j' has a zero axis"),
    (pair("<origin xyz='0 nan 0'/>"), "joint 'j': xyz='0 nan 0'.*not finite"),
    (pair("<origin rpy='inf 0 0'/>"), "not finite"),
    (pair("<limit lower='2' upper='1'/>"), "joint 'j' has limits 2.0 to 1.0"),
    (pair("<mimic joint='z'/>"), "mimics joint 'z', which the file does not"),
    (pair("<mimic joint='j'/>"), "mimics joint 'j' in a cycle"),
    (robot(links("a", "b", "c"), FIXED), "mimics joint 'f', which is fixed"),
)  # fmt: skip
test_damaged_files = refusing(load, file="robot.urdf")(
    ("", "not well-formed XML"),
    ("<robot>", "not well-formed XML"),
    *(
        (b"<?xml version='1.0' encoding='klingon'?><robot/>", "not well-formed XML"),
        (b"<robot>\xff</robot>", "not well"),
    ),
    ("<!DOCTYPE robot [<!ENTITY a 'b'>]><robot>&a;</robot>", r"document type declaration \('robot'\)"),
    ("<robot>" + "<a>" * 64 + "</a>" * 64 + "</robot>", "nests elements more than 64 deep"),
    ("<robot>" + "<a>" * 63 + "</a>" * 63 + "</robot>", ModelError, "1 to 2000 links, got 0"),
    ("<sdf/>", "must be <robot>, got <sdf>"),
    ("<robot><xacro:macro/></robot>", "expand them first"),
    ("<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:macro name='m'/></robot>", "expand them first"),
    ("<robot><link name='${prefix}a'/></robot>", "expand them first"),
    (robot("<xacro:macro name='m'/>"), "holds xacro macros"),
    (pair("<origin xyz='1 2'/>"), "must hold 3"),
    (pair("<origin xyz='1 2 x'/>"), "not a list of numbers"),
    ("<!-- from <xacro:include/> -->\n" + robot(link("base"), end=""), "it ends at line . before an element is closed"),
    (robot(link("base"), "<link name='b'></joint>"), r"mismatched tag: line 3, column"),
    ("version https://git-lfs.github.com/spec/v1\nsize 1\n", "is a Git LFS pointer"),
)


def test_size_limits_and_options(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "box.stl")
    path = put(tmp_path, "m.urdf", with_mesh("box.stl"))
    visual = "<visual><geometry><mesh filename='box.stl'/></geometry></visual>"
    twice = robot(f"<link name='a'>{visual * 2}</link>")
    refused(
        (lambda: load(tmp_path, ARM, limits=FileLimits(max_bytes=100)), "the limit is 100"),
        (lambda: load_urdf(path, limits=FileLimits(max_points=7)), r"box\.stl: claims 8 points"),
        (lambda: load(tmp_path, twice, limits=FileLimits(max_points=10)), "16 vertices"),
    )
    refused((lambda: load_urdf(path, meshes="maybe"), "meshes must be one of warn, require, skip"), error=ValueError)
    monkeypatch.setattr("torchreg.io.urdf.FILE_BUDGET", replace(FILE_BUDGET, xml_bytes=100))
    refused((lambda: load(tmp_path, ARM), "bytes of XML"))


def test_missing_meshes_are_named_or_skipped(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.stl")
    for text, words in (
        (with_mesh("https://example.org/ball.stl"), "is remote"),
        (with_mesh(""), "its <mesh> has no filename"),
        (with_mesh("box.stl", "scale='0 1 1'"), "scale of zero"),
    ):
        with pytest.warns(FileWarning, match=words):
            assert load(tmp_path, text).link_meshes == (None,)
    path = put(tmp_path, "m.urdf", with_mesh("gone.stl"))
    refused((lambda: load_urdf(path, meshes="require"), r"visual of link 'a'.*'gone\.stl' was not found"))
    with pytest.warns(FileWarning, match=r"'gone\.stl' was not found .*package_dirs=; it is left out"):
        assert load_urdf(path).link_meshes == (None,)
    assert load_urdf(path, meshes="skip").link_meshes == (None,)
    # Other geometry stands in for it.
    visual = "<visual><geometry><mesh filename='gone.stl'/></geometry></visual>"
    text = robot(f"<link name='base'>{visual}<collision><geometry>{BOX}</geometry></collision></link>")
    with pytest.warns(FileWarning, match=r"robot\.urdf: visual of link 'base': mesh file 'gone\.stl' was not found"):
        assert [solid.kind for solid in load(tmp_path, text).link_primitives[0]] == ["box"]
    put(tmp_path, "gone.stl", "version https://git-lfs.github.com/spec/v1\nsize 1\n")
    with pytest.warns(FileWarning, match=r"gone\.stl is a Git LFS pointer.*it is left out"):
        assert [solid.kind for solid in load(tmp_path, text).link_primitives[0]] == ["box"]


@pytest.fixture
def folder(tmp_path):
    """A robot's folder, in which box.stl is 1 m, and other/box.stl 2 m wide."""
    (tmp_path / "robot" / "other").mkdir(parents=True)
    for name, size in (("box.stl", 1), ("other/box.stl", 2)):
        trimesh.creation.box(extents=(size, 1, 1)).export(tmp_path / "robot" / name)
    return tmp_path / "robot"


def mesh(folder, name, package_dirs=(), require=True, **options):
    """Return the mesh of a robot's only link."""
    options |= {"package_dirs": package_dirs, "meshes": "require" if require else "skip"}
    return load(folder, with_mesh(name), **options).link_meshes[0]


def width(mesh):
    return float(mesh.bounds()[1, 0] - mesh.bounds()[0, 0])


def test_names_of_meshes_are_places_addresses_or_packages(folder, tmp_path):
    for name, size in (
        ("box.stl", 1), ("other/box.stl", 2), ("../robot/box.stl", 1), (f"file://{folder}/other/box.stl", 2),
        (f"file://{folder}/%62ox.stl", 1), ("package://robot/box.stl", 1), ("model://robot/other/box.stl", 2),
    ):  # fmt: skip
        assert width(mesh(folder, name)) == size, name
    away, mine, name = tmp_path / "elsewhere", tmp_path / "mine" / "robot", "package://other/box.stl"
    away.mkdir()
    mine.mkdir(parents=True)
    for place in (folder, folder / "other"):
        assert width(mesh(away, name, [place])) == 2
    trimesh.creation.box(extents=(3, 1, 1)).export(mine / "box.stl")
    assert width(mesh(folder, "package://robot/box.stl", [mine])) == 3  # given folders come first
    refused(
        (lambda: mesh(away, name), r"mesh file 'package://other/box\.stl' was not found \(looked at "),
        (lambda: mesh(folder, "https://example.org/ball.stl"), "is remote; save it beside the URDF"),
        (lambda: mesh(folder, "box.stl", limits=FileLimits(max_bytes=100)), "the limit is 100"),
    )
    for gone in ("gone.stl", "x" * 5000 + ".stl"):
        refused((lambda gone=gone: mesh(folder, gone), "was not found"))
        assert mesh(folder, gone, require=False) is None


def test_files_are_read_once_and_scenes_are_put_together(folder, monkeypatch):
    box, read, names = "<mesh filename='box.stl'/>", mesh_files.read_bytes, []
    monkeypatch.setattr(mesh_files, "read_bytes", lambda path, *more: names.append(path.name) or read(path, *more))
    found = load(folder, robot(link("a", box), link("b", box), joint("j", "a", "b"))).link_meshes
    assert names == ["box.stl"]
    assert [part.vertices.dtype for part in found] == [torch.float64] * 2
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.add_geometry(trimesh.creation.box())
    scene.export(folder / "two.glb")
    two = mesh(folder, "two.glb")
    assert two.num_faces == 24
    np.testing.assert_allclose(two.bounds()[:, 0], [-0.5, 3.5], atol=1e-6)


def test_collada_comes_in_metres_and_without_its_looks(folder, monkeypatch):
    put(folder, "box.dae", b"<COLLADA/>")
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None)
        words = r".*torchreg-articulated\[urdf\]"
        refused((lambda: mesh(folder, "box.dae"), words), error=tr.errors.MissingExtraError)
        assert mesh(folder, "box.dae", require=False) is None
    pytest.importorskip("collada")
    content = trimesh.exchange.dae.export_collada(trimesh.creation.box())
    broken = content.replace(b"<library_effects>", b"<library_effects><effect id='x'><profile_COMMON/></effect>", 1)
    for text, size in (
        (content, 1),
        (content.replace(b"<up_axis>", b'<unit name="cm" meter="0.01"/><up_axis>', 1), 0.01),
        (b"\n" + broken.replace(b"#", b"#no", 1), 1),
    ):
        put(folder, "box.dae", text)
        assert width(mesh(folder, "box.dae")) == pytest.approx(size)
    doctype = put(folder, "type.dae", b'<!DOCTYPE a [<!ENTITY b "c">]>' + content)
    bad = put(folder, "bad.dae", b"not xml")
    refused(
        (lambda: mesh(folder, doctype.name), r"type\.dae: .*document type"),
        (lambda: mesh(folder, bad.name), r"bad\.dae: not a readable dae mesh"),
    )


def reading(folder, name, content):
    """Return the mesh of a damaged file, which is refused also where a missing one is left out."""
    path = put(folder, name, content)
    with pytest.raises(FormatError):
        mesh(folder, path.name, require=False)
    return mesh(folder, path.name)


test_damaged_meshes = refusing(reading)(
    ("bad.stl", b"solid nothing", r"bad\.stl: must hold 84 \+ 50 x 0 bytes"),
    ("bad.stl", b"\0" * 80 + b"\xff\xff\xff\x7f" + b"\0" * 50, r"bad\.stl: .*it is cut off, damaged or not STL"),
    ("nan.obj", b"v nan 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n", r"nan\.obj: 1 of 3 points are not finite"),
    ("far.obj", b"v 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 4\n", r"far\.obj: a face names a vertex outside 1 to 3"),
    ("empty.obj", b"v 0 0 0\n", r"empty\.obj: holds 1 points but no faces"),
    ("bad.ply", b"ply\nformat ascii 1.0\n", r"bad\.ply: "),
    ("bad.off", b"OFF\n8 6 0\n", r"bad\.off: the header says 8 vertices and 6 faces"),
    ("bad.glb", b"glTF", r"bad\.glb: is cut off in its header"),
    ("mesh.fbx", b"x", r"mesh\.fbx: is of a format that is not read .*export it as glTF"),
    ("mesh.what", b"x", r"mesh\.what: has the unknown ending"),
)
