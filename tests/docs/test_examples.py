"""The examples: short, on public names alone, shown on a page of their own; they run and print numbers."""

import ast
import re
import runpy
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

import torchreg

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_the_examples_are_there():
    names = {path.stem for path in EXAMPLES}
    assert names >= {
        "own_scan", "own_robot", "body_shape", "register_and_pose", "spine_of_sequence", "train_pose_network",
    }  # fmt: skip


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short_public_and_shown(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 90
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchreg"):
            assert node.module.startswith("torchreg.datasets."), f"{path.name} imports from {node.module}"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "tr":
            assert node.attr in torchreg.__all__, f"{path.name} uses tr.{node.attr}"
    page = (ROOT / "docs" / "tutorials" / f"{path.stem}.md").read_text(encoding="utf-8")
    assert f"../../examples/{path.name}" in page


# Those of two scans and of one are examples of README, which are run, with files around them.
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("own_robot", ()),
        pytest.param(
            "body_shape", (), marks=pytest.mark.skipif(find_spec("anny") is None, reason="anny is not installed")
        ),
        ("spine_of_sequence", ()),
        ("train_pose_network", ("6",)),
    ],
)
def test_examples_run_and_print_what_their_pages_say(name, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with torch.random.fork_rng():
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"))
    page = (ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    shown = page.split("It prints\n\n```text\n")[1].split("\n```")[0]

    def words(text):
        return re.sub(r"-?\d+(\.\d+)?", "#", text).splitlines()

    assert words(capsys.readouterr().out.rstrip()) == words(shown)
