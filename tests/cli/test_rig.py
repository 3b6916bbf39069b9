"""A rig from the command line: what is written and printed, exports, refusals."""

import pytest

import torchreg as tr
from tests.rigging.conftest import ANGLES, anew, bending_arm, posed
from torchreg.io.points import save_points


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    arm = bending_arm()
    place = tmp_path_factory.mktemp("arm")
    for number, angle in enumerate(ANGLES[:3]):
        mesh = anew(tr.TriangleMesh(posed(arm, angle), arm.mesh.faces), number)
        save_points(place / f"frame{number}.ply", mesh.vertices, faces=mesh.faces)
    return place


def test_a_folder_becomes_a_rig_with_a_clip(done, folder, tmp_path):
    output = done("rig", folder, "-o", tmp_path / "arm.glb", "--template", 0, "--bones", 4, "--up", "y")
    assert "in the mesh of frame 0; 3 of 3 frames" in output
    found = tr.load(tmp_path / "arm.safetensors")
    assert tr.ArticulatedShape.from_gltf(tmp_path / "arm.glb").num_parts == len(found.joints)
    for name in ("again.glb", "arm.bvh"):
        done("export", tmp_path / "arm", "-o", tmp_path / name)
        assert (tmp_path / name).stat().st_size > 500
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "arm.glb").read_bytes()
    done("view", tmp_path / "arm.safetensors", "--html", tmp_path / "arm.html")


def test_what_cannot_be_rigged_is_refused_in_one_line(error_of, folder, tmp_path):
    output = ("-o", tmp_path / "a.glb")
    assert "--template must be below the number of frames 3" in error_of("rig", folder, *output, "--template", 3)
    assert "two frames at least" in error_of("rig", folder / "frame0.ply", *output)
    assert not list(tmp_path.iterdir())
