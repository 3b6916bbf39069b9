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
        (["track", "--help"], ("--resume", "--overlay")),
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
