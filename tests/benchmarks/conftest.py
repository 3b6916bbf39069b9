"""Benchmarks are scripts, not a package: loaded by path, each under a name of its own."""

import importlib.util
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="session")
def loaded_benchmark():
    """Return the context in which ``benchmarks/NAME.py`` is loaded."""

    @contextmanager
    def loaded(name):
        spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        with pytest.MonkeyPatch.context() as patch:
            # As when they are run: what they share lies beside them.
            patch.syspath_prepend(FOLDER)
            # dataclasses look their module up by name.
            patch.setitem(sys.modules, spec.name, module)
            spec.loader.exec_module(module)
            yield module

    return loaded
