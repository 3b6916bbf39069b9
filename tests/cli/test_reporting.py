"""How commands end: one line per warning, exit codes, interruptions."""

import warnings

import pytest
import typer
from tqdm import tqdm

from torchreg.cli import info
from torchreg.cli.reporting import reporting, show_warning
from torchreg.errors import InputError, TorchregWarning


def test_an_interruption_elsewhere_ends_with_the_same_code(run, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(info, "load_shape", interrupted)
    answer = run("info", "hand")
    assert answer.exit_code == 130
    assert "torchreg: interrupted" in answer.output


def test_other_warnings_say_where_they_come_from(capsys):
    show_warning(UserWarning("a\n  b"), UserWarning, "file.py", 3)
    assert capsys.readouterr().err == "torchreg: warning: file.py:3: a b\n"


def test_warnings_stand_on_a_line_of_their_own_beside_a_progress_bar(capsys):
    with tqdm(total=2, desc="initialize"):
        show_warning(TorchregWarning("a b"), TorchregWarning, "file.py", 3)
    shown = [line.split("\r")[-1] for line in capsys.readouterr().err.split("\n")]
    assert "torchreg: warning: a b" in shown


def test_broken_pipes_are_left_to_the_application(run, monkeypatch):
    def broken(*arguments):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(info, "load_shape", broken)
    answer = run("info", "hand")
    assert answer.exit_code != 0
    assert "torchreg: " not in answer.output


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("sigma must be\n  positive"), 2, "sigma must be positive"),
        (FileNotFoundError(2, "No such file or directory", "a.ply"), 2, "a.ply: No such file or directory"),
        (FileNotFoundError("the folder does not exist"), 2, "the folder does not exist"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_end_in_one_line_and_a_code(error, code, line, capsys):
    @reporting
    def command():
        raise error

    with pytest.raises(typer.Exit) as ended:
        command()
    assert ended.value.exit_code == code
    assert capsys.readouterr().err == f"torchreg: {line}\n"


def test_errors_of_the_program_itself_keep_their_traceback():
    @reporting
    def command():
        raise ZeroDivisionError("a mistake")

    with pytest.raises(ZeroDivisionError, match="a mistake"):
        command()


def test_warnings_of_the_library_are_shown_each_time_and_nothing_is_left_behind(capsys):
    @reporting
    def command(count):
        for _ in range(count):
            warnings.warn("far\n away", TorchregWarning, stacklevel=1)

    before = warnings.showwarning
    command(count=2)
    assert capsys.readouterr().err == "torchreg: warning: far away\n" * 2
    assert warnings.showwarning is before
