"""What all commands share: help, rules of options, hints, warnings and errors in one line, outputs, shapes by name."""

import errno
import os
import re
import subprocess
import sys
import types
import typing
import warnings
from collections import defaultdict

import pytest
import trimesh
import typer
from PIL import Image

import torchreg as tr
from tests.tables import each_row
from torchreg.cli.application import app

HELP = """
import sys
from torchreg.cli.application import main
try:
    main()
finally:
    print(*sorted({"torch", "numpy", "scipy", "matplotlib"} & sys.modules.keys()), file=sys.stderr)
"""
COMMANDS = typer.main.get_command(app).commands
NAMES = ("align", "calibrate", "demo", "export", "figure", "formats", "info", "label", "pose", "register", "rig",
         "spine", "track", "train-initializer", "view")  # fmt: skip
# What may be given twice where there is a source and a target, and how a track names its movie in one word.
TWICE, WORDS = {"--scale", "--time", "--frame", "--intrinsics", "--data"}, {"--movie"}
OPTIONS = defaultdict(dict)
for _name, _command in COMMANDS.items():
    for _item in _command.params:
        for _word in (*_item.opts, *_item.secondary_opts):
            OPTIONS[_word][_name] = _item


@pytest.mark.parametrize("words", [[], ["track"], ["export"]])
def test_help_is_light(words):
    command = [sys.executable, "-c", HELP, *words, "--help"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert all(name in answer.stdout for name in (NAMES if not words else ("Examples:", "-o")))
    assert answer.stderr.split() == []  # nothing heavy is loaded to print help


def test_the_application_has_its_commands_and_runs_on_one_thread_unless_told_otherwise(run, monkeypatch):
    assert set(COMMANDS) == set(NAMES)
    assert run("--version").output == f"torchreg {tr.__version__}\n"
    calls = []
    monkeypatch.setattr(
        "torchreg.cli.application.app", lambda **options: calls.append((options, os.environ["OMP_NUM_THREADS"]))
    )
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    main = sys.modules["torchreg.cli.application"].main
    main()
    monkeypatch.delenv("OMP_NUM_THREADS")
    main()
    assert calls == [({"prog_name": "torchreg"}, "3"), ({"prog_name": "torchreg"}, "1")]


def kind(command, name):
    """Return the type of the values of an option, one of them where there may be several."""
    hint = typing.get_type_hints(command.callback)[name]
    kinds = set(typing.get_args(hint) if isinstance(hint, types.UnionType) else [hint]) - {types.NoneType}
    (found,) = kinds
    return typing.get_args(found)[0] if typing.get_origin(found) is list else found


def test_an_option_is_of_one_kind_and_has_one_help_everywhere():
    for name, items in OPTIONS.items():
        assert len({kind(COMMANDS[command], item.name) for command, item in items.items()}) == 1 or name in WORDS, name
        assert len({item.multiple for item in items.values()}) == 1 or name in TWICE, name
    for name in ("--up", "--force", "--quiet", "--seen", "--mask", "--depth", "--port", "--scale", "--nan-policy"):
        assert len({item.help for item in OPTIONS[name].values() if not item.multiple}) == 1, name
    assert set(OPTIONS["--up"]) == {"align", "track", "register", "rig", "spine", "pose", "view", "export"}
    for command in ("align", "register", "spine"):
        assert command in OPTIONS["--scale"]
        assert command in OPTIONS["--nan-policy"]


@pytest.mark.parametrize("name", NAMES)
def test_what_writes_names_its_output_and_help_is_in_sentences_with_two_right_examples(run, name):
    command = COMMANDS[name]
    known = {word for item in command.params for word in (*item.opts, *item.secondary_opts)}
    if name in ("formats", "info"):
        assert not known & {"--output", "--force"}
    else:
        assert {"--output", "-o", "--quiet"} <= known
        assert ("--force" in known) == (name != "train-initializer")  # it goes on with what is there
        output = OPTIONS["-o"][name].metavar
        assert output == "RESULT" or output.startswith(("OUT.", "FOLDER"))
    assert all((item.help or "").endswith((".", ")")) for item in command.params)
    lines = [line.strip() for line in run(name, "--help").output.splitlines()]
    examples = [line for line in lines[lines.index("Examples:") :] if line.startswith("torchreg ")]
    assert len(examples) == 2
    for example in examples:
        words = example.partition(" | ")[0].split()
        assert words[1] == name
        assert {word for word in words if word.startswith("-")} <= known


@each_row(
    (("register", "a", "b", "--num-bones", "3"), "No such option: --num-bones; did you mean --bones?"),
    (("spine", "a", "--num-tips=5"), "No such option: --num-tips; did you mean --tips?"),
    (("align", "hand", "a", "--serch", "never"), "No such option: --serch; did you mean --search?"),
    (("align", "hand", "a", "--gif", "a.gif"), "No such option: --gif; torchreg export writes it from the result"),
    (("spine", "a", "--seed", "3"), "it gives the same result every time"),
    (("info", "hand", "--qqqq"), "No such option: --qqqq; --help shows all"),
    (("align", "hand", "a", "--initial-pose", "3"), "did you mean --start?"),
)
def test_near_misses_of_options_are_answered(run, words, message):
    answer = run(*words)
    assert answer.exit_code == 2
    assert message in " ".join(answer.output.split())


@each_row(
    ('a.ply: 1 of 3 points are not finite; nan_policy="omit" drops them',
     "a.ply: 1 of 3 points are not finite"),  # `info` reads no clouds: it has no --nan-policy
    ("choose one with skin=NAME: 0 ('a'), 1 ('b')", "choose one with --skin NAME: 0 ('a'), 1 ('b')"),
    ("was not found; name its folder by package_dirs=; it is left out",
     "was not found; name its folder by --package-dir; it is left out"),
    ("a.urdf: not there; pass meshes='skip' to go without", "a.urdf: not there"),
    ("holds 9 bytes, the limit is 4; if you trust it pass FileLimits(max_bytes=...)",
     "holds 9 bytes, the limit is 4"),
    ("visual: xyz='1 2' in <origin> must hold 3 number(s)", "visual: xyz='1 2' in <origin> must hold 3 number(s)"),
    ("is cut\n   off", "is cut off"),
    ("pass size=(640, 480)", "pass size=(640, 480)"),
)  # fmt: skip
def test_hints_are_options_of_the_command_or_left_out(error_of, monkeypatch, message, shown):
    def failed(*arguments, **options):
        raise tr.errors.FormatError(message)

    monkeypatch.setattr("torchreg.shapes.hand.Hand", failed)
    assert error_of("info", "hand") == f"torchreg: {shown}"


@each_row(
    (tr.errors.InputError("sigma must be\n  positive"), 2, "torchreg: sigma must be positive\n"),
    (FileNotFoundError(2, "No such file or directory", "a.ply"), 2, "torchreg: a.ply: No such file or directory\n"),
    (FileNotFoundError("the folder does not exist"), 2, "torchreg: the folder does not exist\n"),
    (KeyboardInterrupt(), 130, "torchreg: interrupted\n"),
    (ZeroDivisionError("a mistake"), 1, ""),  # the program's own keep their traceback
    (BrokenPipeError(32, "Broken pipe"), 1, ""),
)
def test_errors_end_in_one_line_and_a_code(run, monkeypatch, error, code, line):
    def failed(*arguments, **options):
        raise error

    monkeypatch.setattr("torchreg.shapes.hand.Hand", failed)
    answer = run("info", "hand")
    assert (answer.exit_code, answer.output) == (code, line)


def test_warnings_are_shown_each_time_in_a_line_and_nothing_is_left_behind(run, monkeypatch):
    hand = tr.Hand

    def warned(*arguments):
        for _ in range(2):
            warnings.warn("far\n away", tr.errors.UnitsWarning, stacklevel=1)
            warnings.showwarning(UserWarning("a\n  b"), UserWarning, "file.py", 3)
        return hand(*arguments)

    monkeypatch.setattr("torchreg.shapes.hand.Hand", warned)
    before = warnings.showwarning
    output = run("info", "hand").output
    assert output.count("torchreg: warning: far away\n") == 2, output
    assert "torchreg: warning: file.py:3: a b\n" in output
    assert warnings.showwarning is before


def test_hints_of_commands(run, error_of, tmp_path):
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\nnan 0 1\n1 1 1\n")
    shown = error_of("register", tmp_path / "a.xyz", tmp_path / "a.xyz", "-o", tmp_path / "r.safetensors")
    assert shown.endswith("are not finite in float32 (NaN, infinity or overflow); --nan-policy omit drops them")
    robot = (
        "<robot name='a'><link name='a'><visual><geometry><mesh filename='package://p/a.stl'/></geometry></visual>"
        "<collision><geometry><sphere radius='1'/></geometry></collision></link></robot>"
    )
    (tmp_path / "a.urdf").write_text(robot)
    answer = " ".join(run("info", tmp_path / "a.urdf").output.split())
    assert "name its folder by --package-dir; it is left out" in answer
    assert "package_dirs" not in answer
    (tmp_path / "p").mkdir()
    trimesh.creation.box((60.0, 40.0, 300.0)).export(tmp_path / "p" / "a.stl")
    link = "<link name='{}'><visual><geometry><mesh filename='package://p/a.stl'/></geometry></visual></link>"
    (tmp_path / "a.urdf").write_text(
        f"<robot name='r'>{link.format('base')}{link.format('upper')}<joint name='j' type='revolute'>"
        "<parent link='base'/><child link='upper'/><origin xyz='0 0 .3'/><axis xyz='1 0 0'/>"
        "<limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>"
    )
    remedy = 'give <mesh> the attribute scale "0.001 0.001 0.001"'
    assert remedy in " ".join(run("info", tmp_path / "a.urdf", "--package-dir", tmp_path).output.split())


def test_outputs_are_not_overwritten_unless_forced(run, error_of, folder, tmp_path, monkeypatch):
    (tmp_path / "r.json").write_text("mine", encoding="utf-8")
    command = ("align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", "--search", "never")
    assert "r.json exists; pass --force to overwrite it" in error_of(*command)
    assert (tmp_path / "r.json").read_text(encoding="utf-8") == "mine"
    assert run(*command, "--force", "--start", folder / "truth0.json").exit_code == 0

    def full(dir):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("torchreg.cli.outputs.tempfile.TemporaryFile", full)
    message = f"{tmp_path}: nothing can be written there (No space left on device)"
    assert message in error_of(*command, "--force")  # before the work


@each_row(("out", "out.glb"), ("out.json", "out.glb"), ("out.GLB", "out.GLB"), ("out.progress", "out.glb"),
     ("a.v2", "a.v2.glb"))  # fmt: skip
def test_names_of_results_get_their_ending(error_of, tmp_path, given, made):
    (tmp_path / made).touch()
    assert f"{made} exists" in error_of("spine", tmp_path, "-o", tmp_path / given)
    assert "s5.swc must end in .glb; rename the output" in error_of("spine", tmp_path, "-o", tmp_path / "s5.swc")


def test_an_output_has_one_writer_while_it_lives(run, error_of, starfish, tmp_path):
    """A run of another process holds the lock; its sudden end lets the next one in."""
    output, lock = tmp_path / "a.glb", tmp_path / ".a.glb.lock"
    code = (
        "import fcntl, os, sys\nh = open(sys.argv[1], 'a+')\nfcntl.flock(h, fcntl.LOCK_EX)\nh.write(str(os.getpid()))"
    )
    code += "\nh.flush()\nprint('held', flush=True)\nsys.stdin.read()\nos.kill(os.getpid(), 9)"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code, lock], **pipes) as other:
        assert other.stdout.readline() == "held\n"
        command = "spine", starfish, "-o", output, "--tips", 5, "--samples", 6, "--workers", 1
        assert f"being written by another run, process {other.pid}" in error_of(*command)
        other.stdin.close()
    assert run(*command).exit_code == 0
    assert not lock.exists()


def test_info_shows_shapes_in_degrees_and_meters(run, folder, tmp_path):
    robot = folder / "arm.urdf"
    (tmp_path / "ARM.URDF").write_bytes(robot.read_bytes())  # the ending decides in any case
    for file, options, base in ((robot, ["--fixed-base"], "fixed"), (tmp_path / "ARM.URDF", [], "free")):
        lines = [line.split() for line in run("info", file, *options).output.splitlines()]
        for row in (["shoulder", "-90", "to", "57.2958", "deg"], ["rail", "0", "to", "0.25", "m"], ["base_x", base]):
            assert row in lines
        assert ["slider", "ellipsoid", "on", "upper"] in [[*line[:1], "ellipsoid", *line[2:]] for line in lines]
    rig = run("info", folder / "flat.glb", "--parents", folder / "parents.json").output
    assert re.search(r"end +\w+ on middle", rig)
    left, right = (run("info", name).output for name in ("hand-left", "hand"))
    assert "16 parts, 27 degrees of freedom, fused solids" in left
    assert "base_rz               free" in left
    assert left.split("\n", 1)[1].strip() == right.split("\n", 1)[1].strip()


def test_info_shows_what_a_result_holds(run, tmp_path, result, plain_hand):
    type(result)(**{**vars(result), "shape": plain_hand}).save(tmp_path / "r.safetensors")
    for name in ("r.safetensors", "r", "r.json"):
        lines = [line.split() for line in run("info", tmp_path / name).output.splitlines()]
        assert lines[0][1:] == ["AlignResult"]
        for row in (["status", "converged"], ["shape", "Hand"], ["index_pip_flexion", "0", "deg"]):
            assert row in lines


def test_people_have_names(run, interrupted):
    asked = interrupted("torchreg.shapes.articulated.ArticulatedShape.from_anny")
    for name in ("anny-body", "anny-hand", "anny-hand-left"):
        run("info", name)
    assert [words for words, _ in asked] == [("body",), ("hand.R",), ("hand.L",)]


@each_row(
    (["Hand"], "did you mean 'hand'?"),
    (["hand-right"], "did you mean 'hand'?"),
    (["left-hand"], "did you mean 'hand-left'?"),
    (["mano_right.pkl"], "from_skinned_mesh"),
    (["robot.xacro"], "URDF"),
    (["foot"], "SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf"),
    (["scan.ply"], "SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf"),
    (["hand", "--fixed-base"], "--free-base/--fixed-base has no meaning for hand; leave it out"),
    (["hand-left", "--package-dir", "."], "--package-dir has no meaning for hand-left"),
    (["arm.urdf", "--parents", "a.json"], "--parents has no meaning for "),
    (["flat.glb", "--free-base"], "--free-base/--fixed-base has no meaning for "),
    (["flat.glb", "--parents", "{"], "cannot be read as JSON"),
    (["flat.glb", "--parents", "[" * 100_000], "cannot be read as JSON"),
    (["flat.glb", "--parents", "[1]"], "must hold {joint: parent or null}"),
    (["flat.glb", "--parents", '{"root": 1}'], "must hold {joint: parent or null}"),
)
def test_wrong_shapes_are_answered_with_what_there_is(error_of, folder, tmp_path, words, message):
    given = [folder / word if word in ("arm.urdf", "flat.glb") else word for word in words]
    if given[-2:-1] == ["--parents"] and not words[-1].endswith(".json"):
        (tmp_path / "parents.json").write_text(words[-1], encoding="utf-8")
        given[-1] = tmp_path / "parents.json"
    assert message in error_of("info", *given)


def test_figures_are_drawn_and_formats_listed(run, done, error_of, tmp_path, monkeypatch):
    done("figure", "bending", "-o", tmp_path / "fig2.png")
    with Image.open(tmp_path / "fig2.png") as file:
        assert min(file.size) > 100
    assert "NAME must be one of bending, readme; got 'spine'" in error_of("figure", "spine")
    assert "fig2.png exists" in error_of("figure", "bending", "-o", tmp_path / "fig2.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torchreg.viz.figures.readme_picture", lambda path: path)
    assert run("figure", "readme").output == "wrote readme.png\n"
    text = run("formats").output
    for words in ("point clouds and meshes\n  PLY: .ply", "cameras\n", ".csv", "URDF: .urdf"):
        assert words in text
