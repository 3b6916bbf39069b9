"""Every benchmark at least loads; their smoke tests run at night."""

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
LOADS = """
import importlib, pathlib, sys
sys.path[:0] = [sys.argv[1], str(pathlib.Path(sys.argv[1]).parent)]
for path in sorted(pathlib.Path(sys.argv[1]).glob("*.py")):
    print(importlib.import_module(path.stem).__name__)
"""


def test_all_benchmarks_load():
    done = subprocess.run([sys.executable, "-c", LOADS, str(FOLDER)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert {"speed", "find_pose", "scenes"} < set(done.stdout.split())
