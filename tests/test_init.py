"""The public surface: light to import, names load from their owners, ``python -m torchreg`` is the command line."""

import ast
import runpy
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

import torchreg

SOURCE = Path(torchreg.__file__)


def run(code, cwd):
    answer = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.split()


def test_import_is_light(tmp_path):
    heavy = "{'torch', 'numpy', 'scipy', 'matplotlib', 'trimesh', 'kornia', 'typer', 'pytorch_kinematics'}"
    code = f"import sys, torchreg; dir(torchreg); torchreg.errors.InputError; print(*({heavy} & set(sys.modules)))"
    assert run(code, tmp_path) == []


def test_a_used_name_brings_torch(tmp_path):
    code = "import sys, torchreg; torchreg.metrics.chamfer; print('torch' in sys.modules)"
    assert run(code, tmp_path) == ["True"]


def test_the_three_lists_of_names_agree():
    """Type checkers read the guarded imports, users ``__all__``, the interpreter the table of owners."""
    guarded = next(node for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body if isinstance(node, ast.If))
    for_types = {
        alias.name: node.module.removeprefix("torchreg").removeprefix(".")
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert for_types == {**torchreg._OWNERS, **dict.fromkeys(torchreg._MODULES, "")}
    assert set(torchreg.__all__) == {*for_types, "__version__"}
    assert set(torchreg.__all__) <= set(dir(torchreg))


@pytest.mark.parametrize(("name", "owner"), sorted(torchreg._OWNERS.items()))
def test_names_load_from_their_owner(name, owner):
    value = getattr(torchreg, name)
    assert value is getattr(import_module(f"torchreg.{owner}"), name)
    assert value is getattr(torchreg, name)
    assert value.__module__ == f"torchreg.{owner}"


@pytest.mark.parametrize("name", sorted(torchreg._MODULES))
def test_modules_load_by_name(name):
    assert getattr(torchreg, name) is import_module(f"torchreg.{name}")


def test_unknown_names_are_answered_with_the_public_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'algin'; public names: .*\balign\b"):
        torchreg.algin  # noqa: B018


def test_the_version_is_the_installed_one():
    assert torchreg.__version__ == metadata.version("torchreg")


def test_running_the_package_runs_the_command_line(monkeypatch):
    calls = []
    monkeypatch.setitem(sys.modules, "torchreg.cli.application", SimpleNamespace(main=lambda: calls.append("main")))
    runpy.run_module("torchreg", run_name="__main__")
    assert calls == ["main"]
    runpy.run_module("torchreg.__main__", run_name="imported")
    assert calls == ["main"]
