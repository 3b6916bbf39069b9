"""``torchreg train-initializer``: trains, and refuses shapes whose base is bolted down."""

from dataclasses import replace

from typer.testing import CliRunner

from torchreg.alignment import train_initializer as train_module
from torchreg.alignment.pose_proposer import HAND_WEIGHTS, PoseProposer
from torchreg.cli.application import app
from torchreg.shapes.hand import Hand


def test_weights_are_written_and_loaded(tmp_path, monkeypatch):
    small = replace(train_module._TRAINING, surface_points=200, validation=8)
    monkeypatch.setattr(train_module, "_TRAINING", small)
    path = tmp_path / "hand.safetensors"
    command = ["train-initializer", "hand", "-o", str(path), "--minutes", "0.0001", "--batch", "2"]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 0, found.output
    assert "step 1 " in found.output
    assert PoseProposer.load(path, Hand()).dof_names == tuple(Hand().dof_names)


def test_the_weights_of_another_shape_are_refused(tmp_path):
    cloud, rig = tmp_path / "cloud.csv", tmp_path / "rod.urdf"
    cloud.write_text("x,y,z\n" + "\n".join(f"{0.01 * k},0,0.1" for k in range(20)))
    rig.write_text(
        '<robot name="rod"><link name="rod"><visual><geometry><sphere radius="0.1"/></geometry></visual></link></robot>'
    )
    for command, shape, told in (
        (["align", "-o", str(tmp_path / "out")], "hand-left", "another shape"),
        (["track", "-o", str(tmp_path / "track")], str(rig), "another shape"),
        (["align", "--side", "either", "-o", str(tmp_path / "either")], "hand", "--side either"),
    ):
        found = CliRunner().invoke(
            app, [command[0], shape, str(cloud), *command[1:], "--initializer", str(HAND_WEIGHTS)]
        )
        assert found.exit_code == 2
        assert told in found.output
    assert not list(tmp_path.glob("*.json"))


def test_a_base_that_is_bolted_down_is_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><link name="base"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>'
        '<link name="hand"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>'
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="hand"/><origin xyz="0 0 0.2"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    found = CliRunner().invoke(app, ["train-initializer", str(path), "--fixed-base", "-o", str(tmp_path / "arm")])
    assert found.exit_code == 2
    assert "base that can move" in found.output
