"""Benchmarks are scripts, not a package: loaded by path, each under a name of its own."""

import importlib.util
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="session")
def load():
    """Return the function that loads ``benchmarks/NAME.py``, once."""

    @cache
    def loaded(name):
        spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        # dataclasses look their module up by name.
        sys.modules[spec.name] = module
        with pytest.MonkeyPatch.context() as patch:
            # As when they are run: what they share is in the same folder.
            patch.syspath_prepend(FOLDER)
            spec.loader.exec_module(module)
        return module

    return loaded


@pytest.fixture(autouse=True)
def same_threads(load, monkeypatch):
    """Undo what benchmarks change for the whole process: the threads of torch, and an E-step of their own."""
    threads, rivals = torch.get_num_threads(), load("rivals")
    monkeypatch.setitem(rivals.CORRESPONDENCES, rivals.LIGHT, rivals.light_expectation)
    yield
    torch.set_num_threads(threads)
