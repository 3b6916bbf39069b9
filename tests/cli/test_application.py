"""The application: a quick help, every command in it, one thread unless told otherwise."""

import os
import subprocess
import sys

import pytest

import torchreg
from torchreg.cli import application

HELP = """
import sys
from torchreg.cli.application import main
try:
    main()
finally:
    print(*sorted({"torch", "numpy", "scipy", "matplotlib"} & sys.modules.keys()), file=sys.stderr)
"""


COMMANDS = ("align", "demo", "figure", "formats", "info", "label", "pose", "register", "spine", "track", "view")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["--help"],
            COMMANDS,
        ),
        (["track", "--help"], ("--resume", "--pictures")),
    ],
)
def test_help_is_light(arguments, words):
    answer = subprocess.run([sys.executable, "-c", HELP, *arguments], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 0
    assert all(name in answer.stdout for name in words)
    assert answer.stderr.split() == []  # nothing heavy is loaded to print help


def test_every_command_explains_itself(run):
    for command in COMMANDS:
        assert "Usage:" in run(command, "--help").output
    assert "without one the shape is searched for" in " ".join(run("align", "--help").output.split())
    assert run("--version").output == f"torchreg {torchreg.__version__}\n"
    assert run("algin").exit_code == 2


def test_main_runs_the_application_on_one_thread_unless_told_otherwise(monkeypatch):
    calls = []
    monkeypatch.setattr(application, "app", lambda **options: calls.append((options, os.environ["OMP_NUM_THREADS"])))
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    application.main()
    monkeypatch.delenv("OMP_NUM_THREADS")
    application.main()
    assert calls == [({"prog_name": "torchreg"}, "3"), ({"prog_name": "torchreg"}, "1")]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("register", "a", "b", "--num-bones", "3"), "No such option: --num-bones; did you mean --bones?"),
        (("spine", "a", "--num-tips=5"), "No such option: --num-tips; did you mean --tips?"),
        (("align", "hand", "a", "--serch", "never"), "No such option: --serch; did you mean --search?"),
        (("spine", "a", "--seed", "3"), "it gives the same result every time"),
        (("info", "hand", "--qqqq"), "No such option: --qqqq; --help shows all"),
    ],
)
def test_near_misses_of_options_are_answered(run, words, told):
    answer = run(*words)
    assert answer.exit_code == 2
    assert told in " ".join(answer.output.split())


def test_every_help_ends_with_two_examples(run):
    for command in COMMANDS:
        lines = run(command, "--help").output.rstrip().splitlines()
        assert lines[-3].strip() == "Examples:"
        assert all(line.strip().startswith(f"torchreg {command}") for line in lines[-2:])
