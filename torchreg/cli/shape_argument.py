"""The argument SHAPE: a hand by name, or a robot or rigged character by file, with its options."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.errors import FormatError, InputError

if TYPE_CHECKING:
    from torchreg.shapes.articulated import ArticulatedShape

HANDS = {"hand": "right", "hand-left": "left"}
PEOPLE = {"anny-body": "body", "anny-hand": "hand.R", "anny-hand-left": "hand.L"}
_HELP = (
    "hand, hand-left, a robot (.urdf) or a rigged character (.glb, .gltf); or a person of anny: anny-body, anny-hand, "
    "anny-hand-left."
)

Shape = Annotated[str, typer.Argument(metavar="SHAPE", help=_HELP)]
Parents = Annotated[
    Path | None,
    typer.Option(help="JSON file {joint: parent or null}, for glTF files whose hierarchy of nodes is flat."),
]
PackageDir = Annotated[list[Path] | None, typer.Option(help="Folder in which a URDF's package:// names are looked up.")]
Skin = Annotated[
    str | None, typer.Option(metavar="NAME", help="Name or number of the skin, for glTF files that hold several.")
]
FreeBase = Annotated[
    bool | None, typer.Option("--free-base/--fixed-base", help="Whether the base of a URDF moves; by default it does.")
]


def load_shape(
    name: str,
    parents: Path | None = None,
    package_dirs: Sequence[Path] | None = None,
    free_base: bool | None = None,
    skin: str | None = None,
) -> ArticulatedShape:
    """Return the shape of a name or file; InputError if an option has no meaning for its kind."""
    ending = Path(name).suffix.lower()
    rigs = {"--parents", "--skin"}
    uses = {".urdf": {"--package-dir", "--free-base/--fixed-base"}, ".glb": rigs, ".gltf": rigs}
    given = {
        "--parents": parents, "--package-dir": package_dirs or None, "--free-base/--fixed-base": free_base,
        "--skin": skin,
    }  # fmt: skip
    if name not in HANDS and name not in PEOPLE and ending not in uses:
        raise InputError(
            f"SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf, or one of {', '.join(PEOPLE)}; "
            f"got {name!r}; {near_shape(name)}"
        )
    for option, value in given.items():
        if value is not None and option not in uses.get(ending, set()):
            raise InputError(f"{option} has no meaning for {name}; leave it out")
    if name in HANDS:
        from torchreg.shapes.hand import Hand

        return Hand(HANDS[name])
    from torchreg.shapes.articulated import ArticulatedShape

    if name in PEOPLE:
        return ArticulatedShape.from_anny(PEOPLE[name])
    if ending == ".urdf":
        return ArticulatedShape.from_urdf(name, package_dirs=package_dirs or (), free_base=free_base is not False)
    joined = None if parents is None else _read_parents(parents)
    return ArticulatedShape.from_gltf(name, parents=joined, skin=chosen_skin(skin))


def chosen_skin(skin: str | None) -> str | int | None:
    """Return the name or number that --skin gives."""
    return int(skin) if skin is not None and skin.isdecimal() else skin


def near_shape(name: str) -> str:
    """Return what to do with a name that is no shape's, as a hint."""
    plain = name.lower().replace("_", "-")
    if Path(name).suffix.lower() in (".pkl", ".npz") or plain.startswith(("smpl", "mano", "flame")):
        return "arrays of SMPL or MANO are taken in Python, by ArticulatedShape.from_skinned_mesh"
    if Path(name).suffix.lower() in (".xacro", ".sdf", ".mjcf", ".xml"):
        return "turn it into a URDF first, as xacro does"
    near = [hand for hand in HANDS if hand in plain.replace("right", "").strip("-") or plain in hand]
    if plain in ("left", "hand-left", "left-hand", "lefthand"):
        near = ["hand-left"]
    return f"did you mean {near[0]!r}?" if near else "`torchreg info hand` shows what a shape is"


def _read_parents(path: Path) -> dict[str, str | None]:
    from torchreg.io.limits import read_bytes

    try:
        table = json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(table, dict) or not all(isinstance(parent, str | None) for parent in table.values()):
        raise FormatError(f"{path}: must hold {{joint: parent or null}}, all of them names")
    return table
