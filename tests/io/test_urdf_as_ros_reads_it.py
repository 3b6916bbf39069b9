"""Robot descriptions as ROS's tools read them: XML that is not strict, meshes that are elsewhere or missing."""

import re

import pytest
import trimesh

import torchreg as tr
from tests.io.helpers import put
from tests.io.test_urdf import link, robot
from tests.tables import each, each_row, refused
from torchreg.io.urdf import load_urdf

FileWarning, UnitsWarning = tr.errors.FileWarning, tr.errors.UnitsWarning


def joint(child, kind="revolute", limits="<limit lower='-2.2' upper='2.2'/>", parent="base"):
    return (
        f"<joint name='to_{child}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='0 0 0.4'/><axis xyz='0 1 0'/>{limits}</joint>"
    )


ARM = robot(link("base"), link("tip"), joint("tip"))


def saved(folder, content):
    return put(folder, "arm.urdf", content)


@each(
    ARM.replace("<robot name", "<robot xmlns='http://www.ros.org' name"),
    ARM.replace("<robot name", "<robot xmlns:xi='http://www.w3.org/2001/XInclude' name"),
    ARM.replace("</robot>", "<sensor:camera name='eye'><rate>30</rate></sensor:camera></robot>"),
    ARM.replace("<", "<u:").replace("<u:/", "</u:").replace("<u:robot", "<u:robot xmlns:u='http://ros.org'"),
    "<!-- generated -->\n<?xml version='1.0'?>\n" + ARM,
    "<!-- a -->\n<!-- b -->\n\n<?xml version='1.0' encoding='UTF-8'?>\n" + ARM,
    ARM.replace("</robot>", "<!-- <link name='old'/> -- kept for later --></robot>"),
    ARM.replace("</robot>", "<!-- <link name='old'><!-- inner --></link> --></robot>"),
    ARM + "\0\0\n",
    b"\xef\xbb\xbf" + ARM.encode(),
    ("<?xml version='1.0' encoding='utf-16'?>" + ARM).encode("utf-16"),
    b"\r\n \n<?xml version='1.0'?>" + ARM.replace("\n", "\r\n").encode(),
)
def test_xml_that_is_not_strict(tmp_path, content):
    record = load_urdf(saved(tmp_path, content))
    assert record.link_names == ("base", "tip")
    assert [len(solids) for solids in record.link_primitives] == [1, 1]


DEGREES, TIP = "<limit lower='-180' upper='180'/>", link("base") + link("tip")


@each_row(
    *((TIP + joint("tip", kind, ""), f"joint 'to_tip' is {kind}; it is held") for kind in ("floating", "planar")),
    (TIP + joint("tip") + link("table"), "1 of 3 links are left out, as no joint ties .* largest tree: table"),
    (TIP + joint("tip", limits=DEGREES), r"'to_tip' has limits -180 to 180, .* write -3\.142 to 3\.142"),
    (link("base", origin="<origin rpy='0 0 90'/>"), "visual of link 'base' is turned by rpy 0 0 90, which are"),
    (link("base", origin="<origin xyz='1 0 0'/><origin xyz='2 0 0'/>"), "'base' has 2 origins; the first counts"),
    *((link("base") + link("tip", shape) + joint("tip"), words) for shape, words in (
        ("<box size='0 0 0'/>", r"of link 'tip' is left out: <box> needs a positive size, got \(0\.0"),
        ("<cylinder radius='1'/>", "<cylinder> needs a positive radius and length"),
        ("<plane normal='0 0 1'/>", "its geometry <plane> is none of mesh, box"),
        ("<mesh/>", "its <mesh> has no filename"),
    )),
)  # fmt: skip
def test_what_is_left_out_held_or_unlikely_is_warned_of(tmp_path, text, words):
    with pytest.warns(FileWarning, match=rf"arm\.urdf: .*{words}"):
        record = load_urdf(saved(tmp_path, robot(text)))
    assert all(frame.kind == "fixed" for frame in record.tree.joints) == ("is held" in words or len(record.tree) == 1)
    assert record.link_names == (("base", "tip") if "tip" in text else ("base",))
    if "origins" in words:
        assert record.link_primitives[0][0].origin[0, 3] == 1
    if "<" in words:
        assert record.link_primitives[1] == ()


def test_limits_of_a_turn_are_radians_and_a_robot_needs_geometry(tmp_path):
    for limits in ("<limit lower='-6.3' upper='6.3'/>", "<limit lower='-1e16' upper='1e16'/>"):
        load_urdf(saved(tmp_path, robot(TIP, joint("tip", limits=limits))))
    path = saved(tmp_path, robot(link("base", "<mesh/>")))
    words = r"arm\.urdf: no link has geometry that can be read"
    with pytest.warns(FileWarning, match="is left out"):
        refused((lambda: tr.ArticulatedShape.from_urdf(path), words), error=tr.errors.ModelError)


@pytest.fixture
def meshes(tmp_path):
    """A package with a description in its folder urdf and a mesh in its folder meshes."""
    package = tmp_path / "src" / "arm_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    trimesh.creation.box(extents=(2, 1, 1)).export(package / "meshes" / "Box.STL")
    return package


@each(
    "../meshes/Box.STL", "meshes/Box.STL", "package://arm_description/meshes/Box.STL",
    "package://renamed/meshes/Box.STL", r"..\meshes\Box.STL", r"package://arm_description\meshes\Box.STL",
    "../meshes/box.stl", "file:///home/someone/ws/src/arm_description/meshes/Box.STL",
    r"C:\robots\arm_description\meshes\box.stl",
)  # fmt: skip
def test_meshes_are_found_from_the_file_above_it_and_as_on_other_machines(meshes, name):
    path = saved(meshes / "urdf", robot(link("base", f"<mesh filename='{name}'/>", origin="")))
    (mesh,) = load_urdf(path, meshes="require").link_meshes
    assert mesh.bounds()[1].tolist() == [1, 0.5, 0.5]


def rescaled(unit, factor):
    """The words of a warning about meshes in a unit."""
    return re.escape(f'in {unit}; give <mesh> the attribute scale "{factor} {factor} {factor}"')


def chained(sizes, steps=(0.12, 0.4, 0.36), slide="0 0.08", mount="base", mesh=None):
    """Return a robot of four links, one upon the other, and a finger that slides on the last."""
    names = ("base", "turret", "upper", "fore")
    shapes = [f"<box size='{0.3 * s} {0.3 * s} {s}'/>" for s in sizes]
    shapes = [f"<mesh filename='{mesh}' scale='{s} {s} {s}'/>" for s in sizes] if mesh else shapes
    turns = [
        f"<joint name='to_{child}' type='revolute'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='0 0 {step}'/><limit lower='-2' upper='2'/></joint>"
        for parent, child, step in zip(names, names[1:], steps, strict=False)
    ]
    lower, upper = slide.split()
    finger = (
        f"<joint name='grip' type='prismatic'><parent link='{mount}'/><child link='finger'/><origin xyz='0 0 0.1'/>"
        f"<axis xyz='1 0 0'/><limit lower='{lower}' upper='{upper}'/></joint>"
    )
    bodies = [link(name, shape) for name, shape in zip(names, shapes, strict=True)]
    return robot(*bodies, link("finger", "<box size='0.02 0.02 0.08'/>"), *turns, finger)


RIGHT = (0.3, 0.2, 0.45, 0.4)
STEPS = (0.12, 0.4, 0.36)


def times(numbers, factor, only=None):
    return tuple(factor * x if only is None or k == only else x for k, x in enumerate(numbers))


@each_row(
    (chained(times(RIGHT, 1000)), r"links 'base', 'turret', 'upper' and 1 more are .*in millimeters; .* by 0\.001"),
    (chained(times(RIGHT, 1000), mesh="unit.stl"), rescaled("millimeters", 0.001)),
    (chained(times(RIGHT, 1000, 2), mesh="unit.stl"), r"link 'upper' is .* beside joints 0\.4 m .*millimeters"),
    (chained(times(RIGHT, 100), mesh="unit.stl"), rescaled("centimeters", 0.01)),
    (chained(times(RIGHT, 1 / 0.0254), mesh="unit.stl"), rescaled("inches", 0.0254)),
    (chained(RIGHT, times(STEPS, 1000)), r"joints .*'to_upper'.* up to 400 m from .*beside links .*in millimeters"),
    (chained(RIGHT, times(STEPS, 1000, 1)), r"joint 'to_upper' is up to 400 m from the parent"),
    (chained(RIGHT, slide="0 85"), r"joint 'grip' slides from 0 to 85 m, .* in millimeters; write 0 to 0\.085"),
    (chained(RIGHT, slide="-40 0"), r"joint 'grip' slides from -40 to 0 m, .*write -0\.04 to 0"),
    (chained(times(RIGHT, 0.001), mesh="unit.stl").replace("0.02 0.02 0.08", "0.00002 0.00002 0.00008"),
     r"all links are at most 0\.\d+ mm large.*multiply it by 1000"),
)  # fmt: skip
def test_links_joints_and_slides_in_another_unit_are_told(tmp_path, content, words):
    trimesh.creation.box(extents=(0.3, 0.3, 1)).export(tmp_path / "unit.stl")
    with pytest.warns(UnitsWarning, match=rf"arm\.urdf: {words}|arm\.urdf: .*{words}") as caught:
        load_urdf(saved(tmp_path, content))
    assert len(caught) == 1


@each(
    chained(RIGHT),
    chained(times(RIGHT, 40), times(STEPS, 40), slide="0 12"),  # a crane
    chained((8.0, 0.5, 0.5, 0.4), (3.0, 0.4, 0.3), slide="0 12"),  # a gantry on its rail
    chained((0.3, 0.01, 0.01, 0.01)),  # markers at joints
    robot(link("base", "<box size='30 30 0.01'/>"), link("tip"), joint("tip")),  # on the ground
    # Free in the world: a platform on two slides without geometry.
    robot("<link name='world'/><link name='x'/>", link("base"), joint("base", "prismatic", "<limit lower='-50' "
          "upper='50'/>", "x"), joint("x", "prismatic", "<limit lower='-50' upper='50'/>", "world")),
    chained(RIGHT, slide="-3 3"),
)  # fmt: skip
def test_large_robots_and_free_ones_are_as_they_are(tmp_path, content):
    load_urdf(saved(tmp_path, content))  # warnings are errors in tests


def test_names_of_joints_and_parts_are_told_apart_from_others(tmp_path):
    """A joint called like a degree of freedom of the base, and a link called like the second solid of another."""
    second = "<visual><geometry><sphere radius='0.1'/></geometry></visual>"
    base = link("base").replace("</link>", f"{second}</link>")
    text = robot(base, link("base_1"), link("tip"), joint("base_1"), joint("tip"))
    text = text.replace("'to_tip'", "'base_x'").replace("'to_base_1'", "'base_x_joint'")
    with pytest.warns(FileWarning, match="joint 'base_x' is called 'base_x_joint_' here, as base_x moves the whole"):
        shape = tr.ArticulatedShape.from_urdf(saved(tmp_path, text))
    assert shape.dof_names[6:] == ("base_x_joint", "base_x_joint_")
    assert shape.part_names == ("base", "base_1_", "base_1", "tip")
    pose = shape.pose_from_dict({"base_x": 0.5, "base_x_joint_": 0.25})
    assert shape.pose_to_dict(pose)["base_x"] == 0.5
    assert pose.tolist() == [0.5, 0, 0, 0, 0, 0, 0, 0.25]
