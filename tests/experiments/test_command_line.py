import json
import sys

import pytest
from typer.testing import CliRunner

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments import command_line
from experiments.command_line import application, main


@pytest.fixture
def sweep_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "task: probe\nquestion: does it work?\ntrial: {rounds: 2}\ngrid: {outcome: [done, failed], scale: [1, 2]}\n"
    )
    return path


@pytest.fixture
def inline(monkeypatch, inline_engine):
    monkeypatch.setattr(command_line, "make_engine", lambda name, options: inline_engine)


@pytest.fixture
def command(tmp_path):
    """Return the function that runs a command, whose results lie in a new folder, and returns what it prints."""

    def run(*arguments, code=0):
        results = [] if arguments[0] in ("run", "rerun", "list") else ["--results", tmp_path / "results"]
        result = CliRunner().invoke(application, list(map(str, [*arguments, *results])), catch_exceptions=False)
        assert result.exit_code == code
        return result.output

    return run


def test_a_sweep_from_start_to_report(command, sweep_file, tmp_path, inline):
    printed = command("sweep", sweep_file)
    assert "4 trials: 4 run now, 0 finished before; 2 failed, 0 skipped" in printed
    assert "ValueError: the probe was told to fail" in printed
    assert "0 run now, 4 finished before" in command("sweep", sweep_file)
    assert "2 run now, 2 finished before" in command("sweep", sweep_file, "--retry-failed")
    assert "4 records in" in command("collect", sweep_file)
    assert "4" in command("query", sweep_file, "SELECT count(*) FROM trials")
    assert command("report", sweep_file).strip() == str(tmp_path / "results/mine/report.html")
    # Names work too, once there are results.
    assert "4 records in" in command("collect", "mine")


def test_a_report_is_of_the_sweep_as_it_was_run_and_names_edits(command, sweep_file, tmp_path, inline):
    command("sweep", sweep_file, "grid.scale=[7]")
    command("sweep", sweep_file, "grid.scale=[8]")
    assert command("report", sweep_file).strip().endswith("report.html")
    assert "2 records of other configurations" in (tmp_path / "results/mine/report.html").read_text()
    command("sweep", "probe/smoke", "grid.scale=[7]", "seeds=1")
    command("report", "probe/smoke", "--output", tmp_path / "page.html")
    edited = "The configuration differs from the one that the sweep was last run with"
    assert edited in (tmp_path / "page.html").read_text()


def test_a_field_is_swept_in_plain_words_and_ends_with_a_table(command, sweep_file, tmp_path, inline):
    printed = command("sweep", sweep_file, "scale=2,5,7", "outcome=done", "seeds=3")
    head, rule, *rows = printed.splitlines()[1:6]
    assert head.split()[:2] == ["scale", "done"]
    assert set(rule) == {"-"}
    assert [row.split()[:2] for row in rows] == [["2", "3/3"], ["5", "3/3"], ["7", "3/3"]]
    assert all("[" in row for row in rows)
    assert "9 trials: 9 run now" in printed
    command("report", sweep_file)
    page = (tmp_path / "results/mine/report.html").read_text()
    assert "value over scale: median over all others" in page


def test_one_trial_runs_and_prints_what_it_found(command, sweep_file):
    printed = command("run", sweep_file, "size=3")
    assert "done in" in printed
    assert "value " in printed
    assert "the probe was told to fail" in command("run", sweep_file, "outcome=failed", code=1)
    assert "alignment/sigma_schedule\n" in command("list")


def test_a_record_can_be_run_again_and_compared(command, sweep_file, tmp_path, inline):
    command("sweep", sweep_file, "grid.outcome=[done]")
    path = next(iter((tmp_path / "results/mine/trials").glob("*.json")))
    assert "as recorded" in command("rerun", path)
    data = json.loads(path.read_text())
    data["metrics"]["value"] = 12.5
    path.write_text(json.dumps(data))
    assert "recorded: 12.5" in command("rerun", path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep", "alignment/nothing"], "error: unknown configuration 'alignment/nothing'; known ones: alignment/"),
        (["run", "probe/smoke", "sizes=3"], "error: unknown key trial.sizes; known keys of trial: log, outcome"),
        (["run", "probe/smoke", "scale=1,2"], "error: run takes one value of scale; sweep takes several"),
        (["sweep", "probe/smoke", "--engine", "cloud"], "error: unknown engine 'cloud'; known engines: local, ray, sl"),
        (["sweep", "probe/smoke", "--slurm", "partition"], "error: --slurm takes key=value, got 'partition'"),
        (["sweep", "probe/smoke", "--jobs", "0"], "error: --jobs must be at least 1"),
        (["sweep", "probe/smoke", "--sink", "paper"], "error: unknown sink 'paper'; known sinks: tensorboard, mlflow"),
        (["rerun", "nowhere.json"], "error: nowhere.json cannot be read: No such file or directory"),
    ],
)
def test_errors_are_one_line(arguments, message, monkeypatch, capsys, tmp_path):
    results = ["--results", str(tmp_path)] if arguments[0] == "sweep" else []
    monkeypatch.setattr(sys, "argv", ["experiments", *arguments, *results])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    printed = capsys.readouterr().err
    assert printed.startswith(message)
    assert printed.count("\n") == 1


def test_damaged_and_foreign_records_are_reported(command, sweep_file, tmp_path, inline, monkeypatch):
    command("sweep", sweep_file)
    next(iter((tmp_path / "results/mine/trials").glob("*.json"))).write_text("{")
    printed = command("collect", sweep_file)
    assert "left out: " in printed
    assert "3 records in" in printed
    printed = command("sweep", sweep_file, "size=5")
    assert "4 records of other configurations of this sweep are kept beside them" in printed
    assert "set aside and run again: " in command("sweep", sweep_file)
