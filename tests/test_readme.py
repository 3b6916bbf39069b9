"""What README.md promises: .ci/run executes the printed test command, the example runs, links lead somewhere."""

import re
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block_after(marker: str, language: str) -> str:
    match = re.search(rf"^<!-- {marker} -->\n```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert match, f"README.md has no ```{language} block right after <!-- {marker} -->"
    return match.group(1)


@pytest.mark.skipif(shutil.which("bash") is None or shutil.which("awk") is None, reason="needs bash and awk")
def test_ci_runs_the_printed_test_command():
    answer = subprocess.run(
        ["bash", str(ROOT / ".ci" / "run"), "--test-command"], capture_output=True, text=True, check=True, timeout=60
    )
    command = block_after("test command", "bash")
    assert answer.stdout == command
    assert command.count("\n") == 1
    assert "pytest" in command


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_ci_refuses_unknown_arguments():
    answer = subprocess.run(["bash", str(ROOT / ".ci" / "run"), "--fast"], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 2
    assert "usage" in answer.stderr


def without_numbers(text):
    return re.sub(r"-?\d+(\.\d+)?", "#", text)


@pytest.mark.parametrize("marker", ["example", "robot example", "scan example", "spine example"])
def test_example_is_short_and_prints_what_it_says(tmp_path, marker, monkeypatch, capsys):
    example = block_after(marker, "python")
    lines = [line for line in example.splitlines() if line.strip()]
    code = [line for line in lines if not line.startswith("# ")]
    assert len(code) <= 12
    script = tmp_path / "example.py"
    script.write_text(example, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    # In this process, which has all modules loaded.
    with torch.random.fork_rng():
        runpy.run_path(str(script))
    said = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    assert without_numbers(capsys.readouterr().out).splitlines() == [without_numbers(line) for line in said]


def test_local_links_exist():
    targets = re.findall(r"\]\(([^)#\s]+)", README)
    local = [target for target in targets if "://" not in target]
    assert local
    assert [target for target in local if not (ROOT / target).exists()] == []


def test_citation_names_this_version_and_the_papers():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    init = (ROOT / "torchreg" / "__init__.py").read_text(encoding="utf-8")
    version = re.search(r'^__version__ = "(.+)"$', init, re.MULTILINE)
    assert version
    assert re.search(rf"^version: {re.escape(version.group(1))}$", citation, re.MULTILINE)
    assert [year for year in ("2006", "2009", "2004") if f"year: {year}" not in citation] == []
