"""How much of what could break the tests notice: seeded breaks of the code, one at a time.

    python benchmarks/seeded_breaks.py --count 200            # an hour or two on two idle cores
    python benchmarks/seeded_breaks.py --count 40 --jobs 2 --limit 60
    python benchmarks/seeded_breaks.py --smoke                # one break, to see that it runs

A break swaps a comparison, a sum and a difference, a product and a quotient, "and" and "or", or doubles a number, in
a function of torchreg, in a copy of the checkout. Places are drawn evenly over the lines of all rooms, by a hash of
the function's name and of what stands there: a function that only moves to another file keeps its breaks.
The tests of a break are those that import its module, then those of its room and of all public names; it is noticed if
one of them fails within the limit of time.
Breaks that change nothing (a bound that no input reaches) stay unnoticed in any suite: compare shares of two suites.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMPARISONS = {ast.Lt: ">", ast.Gt: "<", ast.LtE: ">=", ast.GtE: "<=", ast.Eq: "!=", ast.NotEq: "=="}
OPERATORS = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
# Tests of files that a copy lacks.
OF_FILES = ("test_packaging.py", "test_readme.py", "test_licenses.py", "test_layers.py")
COPIED = (
    "torchreg",
    "tests",
    "experiments",
    "benchmarks",
    "configs",
    "docs",
    "examples",
    "pyproject.toml",
    "README.md",
)


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

    def rank(self, seed: int) -> str:
        """Return a number drawn for the place, which moving its function to another file does not change."""
        return hashlib.sha256(f"{seed} {self.function} {self.original} {self.number}".encode()).hexdigest()

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


def drawn(count: int, seed: int, root: Path, rooms: Sequence[str] = ()) -> list[Break]:
    """Return breaks at seeded places, spread over the lines of all rooms."""
    every = [
        found for path in sorted((root / "torchreg").rglob("*.py")) for found in breaks_of(path.relative_to(root), root)
    ]
    every = sorted((found for found in every if not rooms or found.room in rooms), key=lambda found: found.rank(seed))
    chosen = (found for found in every if compiles(found, root))
    return [found for _, found in zip(range(count), chosen, strict=False)]


def tests_of(found: Break, root: Path) -> list[str]:
    """Return the test files that look at a module, nearest first."""
    module = ".".join(found.file.with_suffix("").parts)
    every = sorted((root / "tests").rglob("test_*.py"))
    direct = [path for path in every if module in path.read_text()]
    room = [path for path in every if found.room in path.relative_to(root).parts and path not in direct]
    doors = [
        path for path in every if path.parent == root / "tests" and path not in direct and path.name not in OF_FILES
    ]
    return [str(path.relative_to(root)) for path in [*direct, *room, *doors]]


def is_noticed(found: Break, root: Path, limit: float) -> bool:
    """Return whether a test fails where a break is made, in a copy of a checkout."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in COPIED:
            source = root / name
            if source.is_dir():
                shutil.copytree(
                    source, copy / name, ignore=shutil.ignore_patterns("node_modules", "__pycache__", "_build")
                )
            elif source.exists():
                shutil.copy2(source, copy / name)
        broken = copy / found.file
        broken.write_text(found.applied(broken.read_text()))
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "--no-header",
            *tests_of(found, copy),
        ]
        environment = {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(command, cwd=copy, capture_output=True, timeout=limit, env=environment)
        except subprocess.TimeoutExpired:
            return False
    return done.returncode == 1 or done.returncode == 2


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="breaks")
    parser.add_argument("--seed", type=int, default=0, help="of the places")
    parser.add_argument("--jobs", type=int, default=1, help="breaks at a time")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds of tests for each break")
    parser.add_argument("--room", action="append", default=[], help="break this room only; may be given several times")
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout")
    parser.add_argument("--smoke", action="store_true", help="one break of a small module")
    given = parser.parse_args(arguments)
    root = given.root.resolve()
    chosen = drawn(1 if given.smoke else given.count, given.seed, root, ["metrics.py"] if given.smoke else given.room)
    with ThreadPoolExecutor(given.jobs) as pool:
        noticed = list(pool.map(lambda found: is_noticed(found, root, given.limit), chosen))
    made, seen = Counter(found.room for found in chosen), Counter()
    for found, is_seen in zip(chosen, noticed, strict=True):
        seen[found.room] += is_seen
        print(
            f"{'noticed' if is_seen else 'MISSED '} {found.file}:{found.start[0]} {found.function} {found.text.strip()}"
        )
    for room, count in sorted(made.items()):
        print(f"{room:14} {seen[room]:4} of {count:4}")
    print(f"noticed {sum(noticed)} of {len(noticed)}, {sum(noticed) / max(len(noticed), 1):.0%}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
