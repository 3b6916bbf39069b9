"""The public surface: light to import, names load from their owners, ``python -m torchreg`` is the command line."""

import runpy
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

import torchreg

STUB = Path(torchreg.__file__).with_suffix(".pyi")


def run(code, cwd):
    answer = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.split()


def test_import_is_light_and_a_used_name_brings_torch(tmp_path):
    heavy = "{'torch', 'numpy', 'scipy', 'matplotlib', 'trimesh', 'kornia', 'typer', 'pytorch_kinematics'}"
    code = (
        "import sys, torchreg; dir(torchreg); torchreg.errors.InputError;"
        f"print(*({heavy} & set(sys.modules)), 'then'); torchreg.metrics.chamfer; print('torch' in sys.modules)"
    )
    assert run(code, tmp_path) == ["then", "True"]


def test_a_hand_loads_no_library_that_it_does_not_use_and_a_chain_its_own(tmp_path):
    heavy = "{'scipy', 'matplotlib', 'trimesh', 'kornia', 'pytorch_kinematics', 'pygltflib', 'networkx'}"
    code = (
        "import sys, torchreg; hand = torchreg.Hand(); hand.keypoints(hand.rest_pose());"
        f"print(*({heavy} & set(sys.modules)), 'then'); hand.chain; print('pytorch_kinematics' in sys.modules)"
    )
    assert run(code, tmp_path) == ["then", "True"]


def rendered_stub():
    """What type checkers read, from the one table of names."""
    rows = [f"from torchreg import {name} as {name}" for name in torchreg._MODULES]
    for home, names in sorted(torchreg._NAMES.items()):
        rows += [f"from torchreg.{home} import {name} as {name}" for name in names.split()]
    listed = "".join(f"    {name!r},\n" for name in torchreg.__all__).replace("'", '"')
    note = "# Written from the table in __init__.py by `python tests/test_init.py`."
    return "\n".join([note, *rows, "", "__version__: str", f"__all__ = [\n{listed}]", ""])


def test_type_checkers_read_the_same_table():
    assert STUB.read_text(encoding="utf-8") == rendered_stub(), "run: python tests/test_init.py"
    assert set(torchreg.__all__) <= set(dir(torchreg))
    assert len(set(torchreg.__all__)) == len(torchreg.__all__)


@pytest.mark.parametrize(("name", "home"), sorted(torchreg._HOMES.items()))
def test_names_load_from_their_home(name, home):
    value = getattr(torchreg, name)
    assert value is getattr(import_module(f"torchreg.{home}"), name)
    assert value is getattr(torchreg, name)
    assert value.__module__ == f"torchreg.{home}"


@pytest.mark.parametrize("name", sorted(torchreg._MODULES))
def test_modules_load_by_name(name):
    assert getattr(torchreg, name) is import_module(f"torchreg.{name}")


def test_unknown_names_are_answered_with_the_public_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'algin'; public names: .*\balign\b"):
        torchreg.algin  # noqa: B018


def test_the_version_is_the_installed_one():
    try:
        installed = metadata.version("torchreg-articulated")
    except metadata.PackageNotFoundError:
        pytest.skip("torchreg-articulated is not installed: torchreg comes from the checkout")
    assert torchreg.__version__ == installed


def test_running_the_package_runs_the_command_line(monkeypatch):
    calls = []
    monkeypatch.setitem(sys.modules, "torchreg.cli.application", SimpleNamespace(main=lambda: calls.append("main")))
    runpy.run_module("torchreg", run_name="__main__")
    assert calls == ["main"]
    runpy.run_module("torchreg.__main__", run_name="imported")
    assert calls == ["main"]


if __name__ == "__main__":
    STUB.write_text(rendered_stub(), encoding="utf-8")
