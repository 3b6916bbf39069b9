"""What a shape consists of, in degrees and meters, and what a result holds."""

from dataclasses import replace

import trimesh


def test_info_shows_limits_in_degrees_and_meters(run, folder):
    lines = [line.split() for line in run("info", folder / "arm.urdf", "--fixed-base").output.splitlines()]
    assert ["shoulder", "-90", "to", "57.2958", "deg"] in lines
    assert ["rail", "0", "to", "0.25", "m"] in lines
    assert ["base_x", "fixed"] in lines
    assert ["slider", "ellipsoid", "on", "upper"] in [[*line[:1], "ellipsoid", *line[2:]] for line in lines]
    answer = run("info", "hand-left").output
    assert "16 parts, 27 degrees of freedom, fused solids" in answer
    assert "base_rz               free" in answer


def test_info_tells_what_a_result_holds(run, folder, tmp_path, result, plain_hand):
    replace(result, shape=plain_hand).save(tmp_path / "r.safetensors")
    for name in ("r.safetensors", "r"):
        lines = [line.split() for line in run("info", tmp_path / name).output.splitlines()]
        assert lines[0][1:] == ["AlignResult"]
        assert ["status", "converged"] in lines
        assert ["shape", "Hand"] in lines
        assert ["index_pip_flexion", "0", "deg"] in lines


def test_meshes_in_millimeters_are_named_with_the_factor_in_every_command(run, tmp_path):
    trimesh.creation.box((60.0, 40.0, 300.0)).export(tmp_path / "link.stl")
    link = "<link name='{}'><visual><geometry><mesh filename='link.stl'/></geometry></visual></link>"
    (tmp_path / "arm.urdf").write_text(
        f"<robot name='r'>{link.format('base')}{link.format('upper')}"
        "<joint name='j' type='revolute'><parent link='base'/><child link='upper'/><origin xyz='0 0 .3'/>"
        "<axis xyz='1 0 0'/><limit lower='-1' upper='1' effort='1' "
        "velocity='1'/></joint></robot>"
    )
    remedy = 'give <mesh> the attribute scale "0.001 0.001 0.001"'
    assert remedy in " ".join(run("info", tmp_path / "arm.urdf").output.split())
    (tmp_path / "cloud.xyz").write_text("nothing\n")
    assert remedy in run("align", tmp_path / "arm.urdf", tmp_path / "cloud.xyz", "-o", tmp_path / "r").output


def test_near_misses_of_shapes_are_answered(error_of):
    assert "did you mean 'hand'?" in error_of("info", "Hand")
    assert "did you mean 'hand'?" in error_of("info", "hand-right")
    assert "did you mean 'hand-left'?" in error_of("info", "left-hand")
    assert "from_skinned_mesh" in error_of("info", "mano_right.pkl")
    assert "URDF" in error_of("info", "robot.xacro")
