"""The house: import layers and owners of third-party libraries, all read off the source."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

import torchreg as tr

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchreg"

# Low to high; a module imports from lower layers or from its own room only.
LAYERS = [
    {"errors"},
    {"_checks", "_threads"},
    {"metrics"},
    {"geometry"},
    {"io", "solvers"},
    {"result"},
    {"capture", "shapes"},
    {"datasets", "spines", "registration"},
    {"alignment"},
    {"tracking"},
    {"storage", "viz"},
    {"cli"},
    {"__init__", "__main__"},
]
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
SYSTEMS = {"alignment", "tracking", "registration", "spines"}
# One system that may import another, or one module that may.
BRIDGES = {
    ("tracking", "alignment"),
    ("alignment/skeleton_source.py", "spines"),
    ("alignment/search/matched_poses.py", "registration"),
}
# Two rooms of one system that know nothing of each other.
APART = {("registration/dense", "registration/bones"), ("registration/bones", "registration/dense")}

# Files or packages below torchreg/ that may import the library, or a module of it; what is not named here is free.
OWNERS = {
    "pytorch_kinematics": {"shapes/kinematics.py"},
    "kornia": {"geometry/rotation.py", "geometry/rigid.py", "capture"},
    "scipy": {"solvers", "geometry", "registration/dense/blend_sums.py"},
    "scipy.spatial": {"geometry/neighbors.py"},
    "scipy.ndimage": {"geometry/distance_transform.py"},
    "scipy.sparse.csgraph": {"geometry/graphs.py", "solvers/graph_cut.py", "solvers/tracks.py"},
    "skimage": {"capture"},
    "cv2": {"capture"},
    "PIL": {"io", "viz"},
    "OpenEXR": {"io"},
    "trimesh": {"io", "viz"},
    "pygltflib": {"io", "viz"},
    "yaml": {"io"},
    "safetensors": {"io"},
    "matplotlib": {"viz"},
    "viser": {"viz"},
    "websockets": {"viz"},
    "plotly": {"viz"},
    "typer": {"cli"},
    "tqdm": {"cli"},
}
# `from torchreg import x` names the module x, `from torchreg.geometry.mesh import x` something inside mesh.
MODULES_INSIDE = {"torchreg", "scipy", "scipy.sparse"}
# What stands in backticks in the docstring of a system's package may be used outside it.
DOORS = re.compile(r"`(\w+)`")
LAZY = {"matplotlib", "viser", "websockets", "plotly", "cv2", "PIL", "OpenEXR", "rerun"}
LOWEST_THIRD_PARTY = {"errors": set(), "metrics": {"torch"}, "_checks": {"torch"}, "_threads": {"torch"}}
IMPORT_NAMES = {
    "pyyaml": "yaml",
    "pytorch-kinematics": "pytorch_kinematics",
    "scikit-image": "skimage",
    "pillow": "PIL",
    "opencv-python-headless": "cv2",
    "rerun-sdk": "rerun",
}


@dataclass(frozen=True)
class Import:
    """One imported dotted name; ``lazy`` when it happens inside a function or only for type checkers."""

    name: str
    line: int
    lazy: bool


@cache
def imports_of(source: str, path: str) -> tuple[Import, ...]:
    """Return every import in the source of torchreg/``path``, relative ones resolved."""
    package = ["torchreg", *Path(path).parts[:-1]]

    def walk(node: ast.AST, lazy: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            yield from (Import(alias.name, node.lineno, lazy) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names = [alias.name for alias in node.names] if origin in MODULES_INSIDE else [None]
            yield from (Import(f"{origin}.{name}" if name else origin, node.lineno, lazy) for name in names)
        in_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.iter_child_nodes(node):
            yield from walk(child, lazy or in_function or for_types)

    return tuple(walk(ast.parse(source), lazy=False))


def unit_of(path: str) -> str:
    """Return the package, or for a file at the top the module, that torchreg/``path`` belongs to."""
    return Path(path).parts[0].removesuffix(".py")


def folder_of(path: str) -> str:
    """Return the folder of torchreg/``path``."""
    return Path(path).parent.as_posix()


def layer_problems(source: str, path: str) -> list[str]:
    """Return what torchreg/``path`` imports from its own layer's neighbors, from above, or from another system."""
    own = unit_of(path)
    if own not in RANK:
        return [f"torchreg/{path}: {own} has no place in the layers"]
    problems = []
    for item in imports_of(source, path):
        if item.name.split(".")[0] != "torchreg":
            continue
        where = f"torchreg/{path}:{item.line} imports {item.name}"
        inside = item.name.partition(".")[2]
        target = inside.partition(".")[0]
        if (folder_of(path), "/".join(inside.split(".")[:2])) in APART:
            problems.append(f"{where}: {folder_of(path)} knows nothing of it")
        if target == own:
            continue
        if target == "__version__" and RANK[own] >= RANK["cli"]:
            continue
        if target not in RANK:
            problems.append(f"{where}: import from the defining module, not from torchreg")
        elif RANK[target] >= RANK[own]:
            problems.append(f"{where}: {target} does not lie below {own}")
        elif {own, target} <= SYSTEMS and not {(own, target), (path, target)} & BRIDGES:
            problems.append(f"{where}: systems do not import each other")
    return problems


def doors_of(system: str) -> set[str]:
    """Return the names of a system that others may use: the public ones and those that its package names."""
    docstring = ast.get_docstring(ast.parse((PACKAGE / system / "__init__.py").read_text(encoding="utf-8"))) or ""
    return {*tr.__all__, *DOORS.findall(docstring)}


def door_problems(source: str, path: str) -> list[str]:
    """Return what torchreg/``path`` imports from another system by other names than its doors."""
    problems = []
    for node in ast.walk(ast.parse(source)):
        module = (node.module or "").split(".") if isinstance(node, ast.ImportFrom) else []
        if len(module) < 2 or module[0] != "torchreg" or module[1] not in SYSTEMS - {unit_of(path)}:
            continue
        closed = {alias.name for alias in node.names} - doors_of(module[1])
        problems += [f"torchreg/{path}:{node.lineno} imports {name}: no door of {module[1]}" for name in sorted(closed)]
    return problems


def owner_problems(source: str, path: str, declared: set[str]) -> list[str]:
    """Return the third-party imports of torchreg/``path`` that belong elsewhere, are undeclared or not lazy enough."""
    problems = []
    for item in imports_of(source, path):
        library = item.name.split(".")[0]
        where = f"torchreg/{path}:{item.line} imports {library}"
        if library == "torchreg" or library in sys.stdlib_module_names:
            continue
        if library not in declared:
            problems.append(f"{where}, which pyproject.toml does not declare")
        for owned, owners in OWNERS.items():
            if f"{item.name}.".startswith(f"{owned}.") and not {path, path.split("/")[0]} & owners:
                problems.append(f"{where} for {owned}, which belongs to {', '.join(sorted(owners))}")
        if library in LAZY and not item.lazy:
            problems.append(f"{where} when it is imported itself; import {library} inside the function that needs it")
        if library not in LOWEST_THIRD_PARTY.get(unit_of(path), {library}):
            problems.append(f"{where}; the lowest layer knows torch at most")
    return problems


def declared_libraries() -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    rows = [*project["dependencies"], *(row for name in extras if name not in {"test", "dev"} for row in extras[name])]
    names = {re.split(r"[<>=!~\[; ]", row)[0] for row in rows}
    return {IMPORT_NAMES.get(name, name) for name in names}


@cache
def sources() -> dict[str, str]:
    """Return the source of every file of the package by its path."""
    files = sorted(PACKAGE.rglob("*.py"))
    return {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in files}


def test_imports_only_from_lower_layers():
    assert [problem for path, source in sources().items() for problem in layer_problems(source, path)] == []


def test_systems_are_entered_through_their_doors():
    assert [problem for path, source in sources().items() for problem in door_problems(source, path)] == []


@cache
def names_taken() -> list[tuple[str, str, str]]:
    """Return what modules take from others: the package of the one, the other's name, and what is taken."""
    return [
        (unit_of(path), f"{node.module}.", name.name)
        for path, source in sources().items()
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    ]


@pytest.mark.parametrize("system", sorted(SYSTEMS))
def test_every_door_is_used(system):
    used = {name for unit, module, name in names_taken() if unit != system and f".{system}." in module}
    assert doors_of(system) - {*tr.__all__} <= used


def test_third_party_libraries_stay_with_their_owners():
    declared = declared_libraries()
    assert [problem for path, source in sources().items() for problem in owner_problems(source, path, declared)] == []


def test_packages_hold_nothing_but_their_docstring():
    bodies = {path: ast.parse(source).body for path, source in sources().items() if path.endswith("/__init__.py")}
    assert [path for path, body in bodies.items() if len(body) != 1 or not isinstance(body[0], ast.Expr)] == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/mesh.py", "from torchreg.shapes.hand import Hand"),
        ("io/points.py", "from torchreg.solvers.lm import solve"),
        ("errors.py", "from torchreg import result"),
        ("shapes/hand.py", "from torchreg import ArticulatedShape"),
        ("alignment/align.py", "from torchreg import __version__"),
        ("shapes/skin.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torchreg.viz"),
        ("spines/tips.py", "from torchreg.registration.register import register"),
        ("alignment/align.py", "from torchreg.spines.skeletonize import skeletonize"),
        ("registration/bones/labels.py", "from torchreg.registration.dense.align_scans import align_scans"),
        ("helpers/odd.py", ""),
    ],
)
def test_the_layer_check_finds_what_is_wrong(path, source):
    assert len(layer_problems(source, path)) == 1


@pytest.mark.parametrize(
    ("path", "source", "count"),
    [
        ("shapes/hand.py", "import trimesh", 1),
        ("shapes/hand.py", "from pytorch_kinematics import Chain", 1),
        ("geometry/mesh.py", "from kornia.geometry import liegroup", 1),
        ("viz/figures.py", "import matplotlib.pyplot as plt", 1),
        ("viz/figures.py", "def f():\n    import matplotlib.pyplot as plt", 0),
        ("alignment/align.py", "def f():\n    from tqdm import tqdm", 1),
        ("metrics.py", "import numpy", 1),
        ("io/mesh.py", "import plyfile", 1),
        ("geometry/neighbors.py", "from scipy.spatial import cKDTree", 0),
        ("geometry/normals.py", "from scipy.spatial import cKDTree", 1),
        ("geometry/normals.py", "from scipy.sparse import csgraph, csr_array", 1),
        ("solvers/nnls.py", "from scipy.sparse import coo_matrix\nfrom scipy.sparse.linalg import splu", 0),
        ("spines/loops.py", "from scipy.sparse.csgraph import dijkstra", 2),
    ],
)
def test_the_owner_check_tells_right_from_wrong(path, source, count):
    assert len(owner_problems(source, path, declared_libraries())) == count
