"""What is installed under which name: PyPI's ``torchreg`` is another project, ours is ``torchreg-articulated``."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
# An extra of the other project's, or an installation of it by name.
WRONG = re.compile(r"\btorchreg\[\w|\bpip install\b[^\n;&`]*?[ '\"]torchreg(?![\w./-])")
NAMED = re.compile(r"torchreg-articulated\[([\w,]+)\]")


def names(rows):
    return {re.split(r"[<>=!~\[; ]", row)[0].lower() for row in rows}


def texts():
    kinds = {".py", ".md", ".toml", ".j2", ".cff", ".yaml", ".txt", ""}
    for folder in ("torchreg", "experiments", "benchmarks", "tests", "docs", "configs", "examples", ".ci", "."):
        paths = (ROOT / folder).glob("*") if folder == "." else (ROOT / folder).rglob("*")
        for path in paths:
            inside = path.relative_to(ROOT).parts
            if path.is_file() and path.suffix in kinds and not {"_build", "node_modules", "__pycache__"} & {*inside}:
                yield path, path.read_text(encoding="utf-8", errors="replace")


def test_nothing_tells_to_install_the_other_project():
    wrong = [f"{path}: {found[0]}" for path, text in texts() for found in WRONG.finditer(text)]
    assert [row for row in wrong if "test_packaging" not in row] == []


def test_every_extra_that_is_named_exists():
    named = {extra for _, text in texts() for rows in NAMED.findall(text) for extra in rows.split(",")}
    assert {"viewer", "exr", "benchmark"} <= named
    assert named <= {*EXTRAS, "name"}


def test_the_wheel_holds_all_it_needs_in_few_megabytes(tmp_path):
    source = tmp_path / "source"
    for folder in ("torchreg", "experiments", "configs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = "from setuptools import build_meta; import sys; build_meta.build_wheel(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", build, str(tmp_path)], cwd=source, capture_output=True, text=True, timeout=120
    )
    if "No module named 'setuptools'" in done.stderr:
        pytest.skip("setuptools is not installed")
    (wheel,) = tmp_path.glob("torchreg_articulated-*.whl")
    assert wheel.stat().st_size < 8e6
    packed = set(zipfile.ZipFile(wheel).namelist())
    places = {"torchreg": "torchreg", "experiments": "torchreg/experiments", "configs": "torchreg/experiments/configs"}
    kinds = {".py", ".pyi", ".yaml", ".j2", ".json", ".safetensors", ".typed"}
    for folder, place in places.items():
        needed = (path for path in (source / folder).rglob("*") if path.is_file() and path.suffix in kinds)
        missing = {f"{place}/{path.relative_to(source / folder).as_posix()}" for path in needed} - packed
        assert missing == set()
