"""Experiments inside an installation: all their files are packed, and they run under the library's name."""

import ast
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def packed():
    """The arguments that setup.py gives to setuptools."""
    given = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("setuptools.setup", lambda **settings: given.update(settings))
        runpy.run_path("setup.py")
    return given


def test_every_package_and_configuration_is_packed_inside_the_library(packed):
    assert {name.partition(".")[0] for name in packed["packages"]} == {"torchreg"}
    code = {path.parent.relative_to(ROOT) for path in (ROOT / "experiments").rglob("__init__.py")}
    assert {f"torchreg.{'.'.join(path.parts)}" for path in code} <= set(packed["packages"])
    for path in (ROOT / "configs").rglob("*.yaml"):
        name = ".".join(("torchreg.experiments.configs", *path.parent.relative_to(ROOT / "configs").parts))
        assert packed["package_dir"][name] == path.parent.relative_to(ROOT).as_posix()
        assert packed["package_data"][name] == ["*.yaml"]
    weights = [path.relative_to(ROOT / "torchreg") for path in (ROOT / "torchreg").rglob("*.safetensors")]
    assert weights
    assert all(any(path.match(pattern) for pattern in packed["package_data"]["torchreg"]) for path in weights)
    for path in (ROOT / "experiments").rglob("*.j2"):
        patterns = packed["package_data"]["torchreg.experiments"]
        assert f"{path.parent.name}/*.j2" in patterns


def test_modules_import_each_other_by_relative_names():
    """Installed, the package has another name."""
    for path in (ROOT / "experiments").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not [name for name in names if name.partition(".")[0] == "experiments"], f"{path}:{node.lineno}"


def test_an_installation_sweeps_from_anywhere(tmp_path):
    """The layout of the wheel, laid out by hand."""
    site = tmp_path / "site"
    shutil.copytree(ROOT / "torchreg", site / "torchreg", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "experiments", site / "torchreg/experiments", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "configs", site / "torchreg/experiments/configs")
    done = subprocess.run(
        [sys.executable, "-m", "torchreg.experiments", "sweep", "probe/smoke", "scale=2,3", "seeds=1", "rounds=1",
         "size=2", "--results", str(tmp_path / "results")],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(site)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "run now, 0 finished before; 0 failed, 0 skipped" in done.stdout
    assert (tmp_path / "results/probe/smoke/trials").is_dir()
