import json
import sys

import pytest
from typer.testing import CliRunner

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments import command_line
from experiments.command_line import application, main
from experiments.errors import ConfigError


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
    return inline_engine


def command(*arguments):
    result = CliRunner().invoke(application, list(map(str, arguments)), catch_exceptions=False)
    return result.exit_code, result.output


def test_a_sweep_from_start_to_report(sweep_file, tmp_path, inline):
    results = ("--results", tmp_path / "results")
    code, told = command("sweep", sweep_file, *results)
    assert code == 0
    assert "4 trials: 4 run now, 0 finished before; 2 failed, 0 skipped" in told
    assert "ValueError: the probe was told to fail" in told
    assert "0 run now, 4 finished before" in command("sweep", sweep_file, *results)[1]
    assert "2 run now, 2 finished before" in command("sweep", sweep_file, "--retry-failed", *results)[1]
    assert "4 records in" in command("collect", sweep_file, *results)[1]
    assert "4" in command("query", sweep_file, "SELECT count(*) FROM trials", *results)[1]
    _, told = command("report", sweep_file, *results)
    assert told.strip() == str(tmp_path / "results/mine/report.html")
    # Names work too, once there are results.
    assert "4 records in" in command("collect", "mine", *results)[1]


def test_a_report_is_of_the_sweep_as_it_was_run(sweep_file, tmp_path, inline):
    results = ("--results", tmp_path / "results")
    command("sweep", sweep_file, "grid.scale=[7]", *results)
    command("sweep", sweep_file, "grid.scale=[8]", *results)
    _, path = command("report", sweep_file, *results)
    page = (tmp_path / "results/mine/report.html").read_text()
    assert "2 records of other configurations" in page
    assert path.strip().endswith("report.html")


def test_a_report_tells_that_its_configuration_was_edited(tmp_path, inline, monkeypatch):
    command("sweep", "probe/smoke", "grid.scale=[7]", "seeds=1", "--results", tmp_path)
    command("report", "probe/smoke", "--results", tmp_path, "--output", tmp_path / "page.html")
    assert (
        "The configuration differs from the one that the sweep was last run with"
        in (tmp_path / "page.html").read_text()
    )


def test_a_field_is_swept_in_plain_words_and_ends_with_a_table(sweep_file, tmp_path, inline):
    results = ("--results", tmp_path)
    code, told = command("sweep", sweep_file, "scale=2,5,7", "outcome=done", "seeds=3", *results)
    assert code == 0
    head, rule, *rows = told.splitlines()[1:6]
    assert head.split()[:2] == ["scale", "done"]
    assert set(rule) == {"-"}
    assert [row.split()[:2] for row in rows] == [["2", "3/3"], ["5", "3/3"], ["7", "3/3"]]
    assert all("[" in row for row in rows)
    assert "9 trials: 9 run now" in told
    command("report", sweep_file, *results)
    assert "value over scale: median over all others" in (tmp_path / "mine/report.html").read_text()


def test_one_trial_takes_one_value(sweep_file):
    with pytest.raises(ConfigError, match="run takes one value of scale; sweep takes several"):
        command("run", sweep_file, "scale=1,2")


def test_one_trial_runs_and_prints_what_it_found(sweep_file):
    code, told = command("run", sweep_file, "size=3")
    assert code == 0
    assert "done in" in told
    assert "value " in told
    code, told = command("run", sweep_file, "outcome=failed")
    assert code == 1
    assert "the probe was told to fail" in told


def test_a_record_can_be_run_again_and_compared(sweep_file, tmp_path, inline):
    command("sweep", sweep_file, "grid.outcome=[done]", "--results", tmp_path)
    path = next(iter((tmp_path / "mine/trials").glob("*.json")))
    assert "as recorded" in command("rerun", path)[1]
    data = json.loads(path.read_text())
    data["metrics"]["value"] = 12.5
    path.write_text(json.dumps(data))
    assert "recorded: 12.5" in command("rerun", path)[1]


def test_configurations_are_listed():
    assert "alignment/sigma_schedule\n" in command("list")[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep", "alignment/nothing"], "error: unknown configuration 'alignment/nothing'; known ones: alignment/"),
        (["run", "probe/smoke", "sizes=3"], "error: unknown key trial.sizes; known keys of trial: log, outcome"),
        (["sweep", "probe/smoke", "--engine", "cloud"], "error: unknown engine 'cloud'"),
        (["sweep", "probe/smoke", "--slurm", "partition"], "error: --slurm takes key=value, got 'partition'"),
        (["sweep", "probe/smoke", "--jobs", "0"], "error: --jobs must be at least 1"),
        (["sweep", "probe/smoke", "--sink", "paper"], "error: unknown sink 'paper'"),
        (["rerun", "nowhere.json"], "error: nowhere.json cannot be read: No such file or directory"),
    ],
)
def test_errors_are_one_line(arguments, message, monkeypatch, capsys, tmp_path):
    results = ["--results", str(tmp_path)] if arguments[0] == "sweep" else []
    monkeypatch.setattr(sys, "argv", ["experiments", *arguments, *results])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    told = capsys.readouterr().err
    assert told.startswith(message)
    assert told.count("\n") == 1


def test_interrupting_says_that_nothing_is_lost(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(command_line, "application", interrupted)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert "finished trials are kept" in capsys.readouterr().err


def test_damaged_and_foreign_records_are_told(sweep_file, tmp_path, inline):
    results = ("--results", tmp_path)
    command("sweep", sweep_file, *results)
    next(iter((tmp_path / "mine/trials").glob("*.json"))).write_text("{")
    _, told = command("collect", sweep_file, *results)
    assert "left out: " in told
    assert "3 records in" in told
    _, told = command("sweep", sweep_file, "size=5", *results)
    assert "4 records of other configurations of this sweep are kept beside them" in told
    _, told = command("sweep", sweep_file, *results)
    assert "set aside and run again: " in told


def test_a_sweep_that_no_process_can_run_ends_with_an_error(sweep_file, tmp_path, monkeypatch):
    class Dead:
        def run(self, jobs):
            from experiments.worker import Outcome

            yield from (Outcome(job.id, "lost") for job in jobs)

        def close(self):
            pass

    monkeypatch.setattr(command_line, "make_engine", lambda name, options: Dead())
    code, told = command("sweep", sweep_file, "--results", tmp_path)
    assert code == 1
    assert "4 trials have no result" in told
