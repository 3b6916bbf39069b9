"""SHAPE: hands by name, robots and rigs by file, and what each kind has no use for."""

import pytest

from torchreg.cli.shape_argument import load_shape
from torchreg.errors import FormatError, InputError


def test_hands_have_names():
    left, right = load_shape("hand-left"), load_shape("hand")
    rest = left.rest_pose()
    mirrored = right.keypoints(rest) * rest.new_tensor([-1.0, 1.0, 1.0])
    assert left.keypoints(rest).allclose(mirrored, atol=1e-6)
    assert not left.keypoints(rest).allclose(right.keypoints(rest), atol=1e-3)


def test_people_have_names(monkeypatch):
    asked = []
    monkeypatch.setattr("torchreg.shapes.articulated.ArticulatedShape.from_anny", asked.append)
    for name in ("anny-body", "anny-hand", "anny-hand-left"):
        load_shape(name)
    assert asked == ["body", "hand.R", "hand.L"]


def test_robots_are_files_with_a_free_base_unless_fixed(folder):
    name = str(folder / "arm.urdf")
    assert load_shape(name).lower[:6].isinf().all()
    assert load_shape(name, free_base=True).lower[:6].isinf().all()
    fixed = load_shape(name, free_base=False)
    assert (fixed.lower[:6] == fixed.upper[:6]).all()
    assert fixed.part_names == ("base", "upper", "slider")


def test_the_ending_tells_the_kind_in_any_case(folder, tmp_path):
    (tmp_path / "ARM.URDF").write_bytes((folder / "arm.urdf").read_bytes())
    assert load_shape(str(tmp_path / "ARM.URDF")).num_parts == 3


def test_parents_join_what_the_file_leaves_flat(folder):
    rig = load_shape(str(folder / "flat.glb"), parents=folder / "parents.json")
    assert (rig.part_names, rig.part_parents) == (("root", "middle", "end"), (-1, 0, 1))


def test_package_dirs_are_looked_into(folder, tmp_path):
    box = '<mesh filename="package://arm/box.obj"/>'
    text = (folder / "arm.urdf").read_text(encoding="utf-8").replace('<sphere radius="0.06"/>', box)
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    (tmp_path / "found" / "arm").mkdir(parents=True)
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "found" / "arm" / "box.obj").write_text(corners, encoding="utf-8")
    assert load_shape(str(tmp_path / "arm.urdf"), package_dirs=[tmp_path / "found"]).num_parts == 3


def test_options_without_meaning_are_refused(folder):
    for name, options, message in [
        ("hand", {"free_base": False}, "--free-base/--fixed-base has no meaning for hand; leave it out"),
        ("hand-left", {"package_dirs": [folder]}, "--package-dir has no meaning for hand-left"),
        (str(folder / "arm.urdf"), {"parents": folder / "parents.json"}, "--parents has no meaning for "),
        (str(folder / "flat.glb"), {"free_base": True}, "--free-base/--fixed-base has no meaning for "),
    ]:
        with pytest.raises(InputError, match=message):
            load_shape(name, **options)
    assert load_shape("hand", package_dirs=[]).num_parts == 16


def test_other_names_are_answered_with_what_there_is(error_of):
    for name in ("foot", "scan.ply"):
        with pytest.raises(InputError, match=r"SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf"):
            load_shape(name)
    assert "SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf" in error_of("info", "foot")


def test_parents_must_be_a_table_of_names(folder, tmp_path, error_of):
    for text, message in [
        ("{", "cannot be read as JSON"),
        ("[" * 100_000, "cannot be read as JSON"),
        ("[1]", r"must hold \{joint: parent or null\}"),
        ('{"root": 1}', r"must hold \{joint: parent or null\}"),
    ]:
        (tmp_path / "parents.json").write_text(text, encoding="utf-8")
        with pytest.raises(FormatError, match=message):
            load_shape(str(folder / "flat.glb"), parents=tmp_path / "parents.json")
    flat = ("info", folder / "flat.glb", "--parents", tmp_path / "parents.json")
    assert "parents.json: must hold {joint: parent or null}" in error_of(*flat)
