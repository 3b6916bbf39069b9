"""Messages in the words of a command: arguments of functions become its options, others are left out."""

import pytest

from torchreg.cli.align import align
from torchreg.cli.hints import in_options
from torchreg.cli.register import register
from torchreg.cli.reporting import options_of
from torchreg.cli.spine import spine

OPTIONS = ("--nan-policy", "--scale", "--package-dir", "--skin", "--parents")


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ('a.ply: 1 of 3 points are not finite; nan_policy="omit" drops them',
         "a.ply: 1 of 3 points are not finite; --nan-policy omit drops them"),
        ("If they are in millimeters, load them with scale=0.001",
         "If they are in millimeters, load them with --scale 0.001"),
        ("choose one with skin=NAME: 0 ('a'), 1 ('b')", "choose one with --skin NAME: 0 ('a'), 1 ('b')"),
        ("was not found; name its folder by package_dirs=; it is left out",
         "was not found; name its folder by --package-dir; it is left out"),
        ("a.urdf: not there; pass meshes='skip' to go without", "a.urdf: not there"),
        ("holds 9 bytes, the limit is 4; if you trust it pass FileLimits(max_bytes=...)",
         "holds 9 bytes, the limit is 4"),
        ("visual: xyz='1 2' in <origin> must hold 3 number(s)", "visual: xyz='1 2' in <origin> must hold 3 number(s)"),
        ("is cut\n   off", "is cut off"),
    ],
)  # fmt: skip
def test_hints_can_be_followed(message, told):
    assert in_options(message, OPTIONS) == told


def test_a_hint_that_is_all_there_is_stays():
    assert in_options("pass size=(640, 480)", ()) == "pass size=(640, 480)"


@pytest.mark.parametrize("command", [align, register, spine])
def test_units_and_points_that_are_not_finite_have_options_everywhere(command):
    assert {"--scale", "--nan-policy"} <= set(options_of(command))


def test_hints_of_commands(run, error_of, tmp_path):
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\nnan 0 1\n1 1 1\n")
    told = error_of("register", tmp_path / "a.xyz", tmp_path / "a.xyz", "-o", tmp_path / "r.safetensors")
    assert told.endswith(
        "1 of 5 points are not finite in float32 (NaN, infinity or overflow); --nan-policy omit drops them"
    )
    (tmp_path / "a.urdf").write_text(
        "<robot name='a'><link name='a'><visual><geometry><mesh filename='package://p/a.stl'/></geometry></visual>"
        "<collision><geometry><sphere radius='1'/></geometry></collision></link></robot>"
    )
    answer = run("info", tmp_path / "a.urdf")
    assert answer.exit_code == 0
    assert "name its folder by --package-dir; it is left out" in " ".join(answer.output.split())
    assert "package_dirs" not in answer.output


def test_the_formats_are_listed_by_what_they_hold(run):
    text = run("formats").output
    for words in ("point clouds and meshes\n  PLY: .ply", "cameras\n", ".csv", "URDF: .urdf"):
        assert words in text
