"""How much of what could break the tests notice: seeded breaks of the code, one at a time.

    python benchmarks/seeded_breaks.py --count 200 --covered breaks.db     # an hour of one core; --jobs 2 for two
    python benchmarks/seeded_breaks.py --count 40 --limit 60 --room spines
    python benchmarks/seeded_breaks.py --root ../before --like .    # another checkout, at the places that both have
    python benchmarks/seeded_breaks.py --smoke                # one break, to see that it runs

A break swaps a comparison, a sum and a difference, a product and a quotient, "and" and "or", or doubles a number, in
a function of torchreg, in a copy of the checkout. Places are drawn evenly over the lines of all rooms, by a hash of
the function's name and of what stands there: a function that only moves to another file keeps its breaks.
The tests of a break are those that run its line, where ``--covered`` says which they are (the whole suite is run once
for that, a quarter of an hour, if there is no such file), else those that import its module, then those of its room and
of all public names; nearest first, up to the first that fails. A break that the suite has not noticed within the limit
of processor time is counted by itself: the limit is the reason, not the suite. Breaks that change nothing (a bound that
no input reaches) stay unnoticed in any suite: compare shares of two suites.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
COMPARISONS = {ast.Lt: ">", ast.Gt: "<", ast.LtE: ">=", ast.GtE: "<=", ast.Eq: "!=", ast.NotEq: "=="}
OPERATORS = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
# Tests of all public names, of which those of a room know nothing.
OF_DOORS = ("test_contracts.py", "test_default_dtypes.py", "test_far_coordinates.py", "test_storage.py")
FOLDERS = ("torchreg", "tests", "experiments", "benchmarks", "configs", "docs", "examples")
UNWANTED = shutil.ignore_patterns("node_modules", "__pycache__", "_build")


@dataclass(frozen=True)
class Break:
    """A place in a file, and the text that stands there instead."""

    file: Path
    function: str
    original: str
    number: int
    start: tuple[int, int]
    end: tuple[int, int]
    text: str

    @property
    def place(self) -> str:
        """What stands there: moving the function to another file does not change it."""
        return f"{self.function} {self.original} {self.number}"

    def rank(self, seed: int) -> str:
        """Return a number drawn for the place."""
        return hashlib.sha256(f"{seed} {self.place}".encode()).hexdigest()

    @property
    def room(self) -> str:
        """The package that the file lies in, or its own name."""
        return self.file.parts[1] if len(self.file.parts) > 2 else self.file.name

    def applied(self, source: str) -> str:
        """Return the source of the file with the break."""
        lines = source.splitlines(keepends=True)
        (first, left), (last, right) = self.start, self.end
        before, after = lines[first - 1].encode()[:left].decode(), lines[last - 1].encode()[right:].decode()
        return "".join([*lines[: first - 1], before + self.text + after, *lines[last:]])


def breaks_of(file: Path, root: Path) -> Iterator[Break]:
    """Yield all breaks of the functions of a file."""
    source = (root / file).read_text()
    tree, numbers = ast.parse(source), Counter[tuple[str, str]]()
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            pair = replacement(node, source)
            if pair is not None:
                place, text = pair
                numbers[function.name, ast.dump(node)] += 1
                number = numbers[function.name, ast.dump(node)]
                yield Break(
                    file, function.name, ast.dump(node), number, (place[0], place[1]), (place[2], place[3]), text
                )


def replacement(node: ast.AST, source: str) -> tuple[tuple[int, int, int, int], str] | None:
    """Return where a node lies and the text that breaks it, or None."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
        return between(node.left, node.comparators[0]), f" {COMPARISONS[type(node.ops[0])]} "
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        return between(node.left, node.right), f" {OPERATORS[type(node.op)]} "
    if isinstance(node, ast.BoolOp) and len(node.values) == 2:
        return between(*node.values), " or " if isinstance(node.op, ast.And) else " and "
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return (node.lineno, node.col_offset, node.end_lineno or 0, node.end_col_offset or 0), repr(2 * node.value + 1)
    return None


def between(left: ast.expr, right: ast.expr) -> tuple[int, int, int, int]:
    return left.end_lineno or 0, left.end_col_offset or 0, right.lineno, right.col_offset


def compiles(found: Break, root: Path) -> bool:
    """Return whether the broken file is Python still, and another program: parentheses may stand at the place."""
    source = (root / found.file).read_text()
    try:
        return ast.dump(ast.parse(found.applied(source))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


def every_break(root: Path) -> list[Break]:
    files = sorted((root / "torchreg").rglob("*.py"))
    return [found for path in files for found in breaks_of(path.relative_to(root), root)]


def drawn(count: int, seed: int, root: Path, rooms: Sequence[str] = (), like: Path | None = None) -> list[Break]:
    """Return breaks at seeded places, spread over the lines of all rooms; those that another checkout has, too."""
    shared = None if like is None else {found.place for found in every_break(like)}
    every = [found for found in every_break(root) if not rooms or found.room in rooms]
    every = [found for found in every if shared is None or found.place in shared]
    chosen = (found for found in sorted(every, key=lambda found: found.rank(seed)) if compiles(found, root))
    return [found for _, found in zip(range(count), chosen, strict=False)]


def tests_of(found: Break, root: Path) -> list[str]:
    """Return the test files that look at a module, nearest first: of its folder, of its room, that import it."""
    module, tests = ".".join(found.file.with_suffix("").parts), root / "tests"
    every = sorted(tests.rglob("test_*.py"))
    folder = [path for path in every if path.parent == tests.joinpath(*found.file.parent.parts[1:])]
    room = [path for path in every if found.room in path.relative_to(root).parts]
    direct = [path for path in every if module in path.read_text()]
    doors = [tests / name for name in OF_DOORS if (tests / name) in every]
    inner = [path for path in direct if path in room]
    nearest = [path for path in inner if path in folder], inner, folder, room, direct, doors
    return list(dict.fromkeys(str(path.relative_to(root)) for paths in nearest for path in paths))


def covering(found: Break, root: Path, covered: CoverageData) -> list[str]:
    """Return the tests that run the line of a break, nearest files first, not more than a command can name."""
    file = next((name for name in covered.measured_files() if name.endswith(str(found.file))), "")
    tests_by_line = covered.contexts_by_lineno(file)
    line = max((line for line in tests_by_line if line <= found.start[0]), default=0)
    tests = {context.partition("|")[0] for context in tests_by_line.get(line, []) if context}
    nearest = {name: place for place, name in enumerate(tests_of(found, root))}
    return sorted(tests, key=lambda test: (nearest.get(test.partition("::")[0], len(nearest)), test))[:2000]


def coverage_of(root: Path, file: Path) -> CoverageData:
    """Return which tests run which line of a checkout; its whole suite makes the file if there is none."""
    from coverage import CoverageData

    if not file.exists():
        options = ["-q", "--cov=torchreg", "--cov-context=test", "--cov-report=", "--cov-fail-under=0"]
        environment = {**os.environ, "COVERAGE_FILE": str(file.resolve()), "PYTHONPATH": str(root)}
        subprocess.run([sys.executable, "-m", "pytest", *options], cwd=root, env=environment, check=False)
    data = CoverageData(str(file))
    data.read()
    return data


def copied(root: Path, folder: Path) -> Path:
    """Copy what tests need of a checkout, and return the folder."""
    for name in (*FOLDERS, "pyproject.toml", "README.md"):
        if (root / name).is_dir():
            shutil.copytree(root / name, folder / name, ignore=UNWANTED)
        elif (root / name).exists():
            shutil.copy2(root / name, folder / name)
    return folder


def outcome(found: Break, copy: Path, tests: Sequence[str], limit: float) -> str:
    """Return "noticed" where a test of a copy with the break fails, else "MISSED", or "no time" beyond the limit."""
    if not tests:
        return "MISSED"
    broken = copy / found.file
    whole = broken.read_text()
    options = ["-x", "-q", "-p", "no:cacheprovider", "--no-header"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    environment = {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        broken.write_text(found.applied(whole))
        with subprocess.Popen(command, cwd=copy, env=environment, start_new_session=True, **quiet) as run:
            resource.prlimit(run.pid, resource.RLIMIT_CPU, (round(limit), round(limit) + 1))
            try:
                code = run.wait(20 * limit)  # something may wait for ever
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                code = -1
    finally:
        broken.write_text(whole)
    return "noticed" if code in (1, 2) else "MISSED" if code == 0 else "no time"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="breaks")
    parser.add_argument("--seed", type=int, default=0, help="of the places")
    parser.add_argument("--jobs", type=int, default=1, help="breaks at a time")
    parser.add_argument("--limit", type=float, default=120.0, help="processor seconds of tests for each break")
    parser.add_argument("--room", action="append", default=[], help="break this room only; may be given several times")
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout")
    parser.add_argument("--like", type=Path, help="another checkout: only places that it has as well")
    parser.add_argument("--covered", type=Path, help="file of which tests run which line; made if there is none")
    parser.add_argument("--smoke", action="store_true", help="one break of a small module")
    given = parser.parse_args(arguments)
    if given.smoke:
        given.count, given.room = 1, ["metrics.py"]
    root = given.root.resolve()
    chosen = drawn(given.count, given.seed, root, given.room, given.like)
    covered = None if given.covered is None else coverage_of(root, given.covered)
    suites = [tests_of(found, root) if covered is None else covering(found, root, covered) for found in chosen]
    counts, copies = Counter[tuple[str, str]](), SimpleQueue[Path]()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        for number in range(given.jobs):
            (Path(folder) / str(number)).mkdir()
            copies.put(copied(root, Path(folder) / str(number)))

        def tried(found: Break, tests: list[str]) -> str:
            copy = copies.get()
            try:
                return outcome(found, copy, tests, given.limit)
            finally:
                copies.put(copy)

        for found, result in zip(chosen, pool.map(tried, chosen, suites), strict=True):
            counts[found.room, result] += 1
            place = f"{found.file}:{found.start[0]} {found.function}"
            print(f"{result} {place}: {found.text.strip()}", flush=True)
    for room in sorted({room for room, _ in counts}):
        print(f"{room:14}", *(f"{result} {counts[room, result]:3}" for result in ("noticed", "MISSED", "no time")))
    sums = Counter(dict.fromkeys(("noticed", "MISSED", "no time"), 0))
    for (_, result), number in counts.items():
        sums[result] += number
    noticed, decided = sums["noticed"], sums["noticed"] + sums["MISSED"]
    print(f"noticed {noticed} of {decided}, {noticed / max(decided, 1):.0%}; {sums['no time']} not within the limit")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
