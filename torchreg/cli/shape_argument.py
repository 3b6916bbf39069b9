"""The argument SHAPE: a hand by name, or a robot or rigged character by file, with its options."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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


@dataclass(frozen=True)
class ShapeOptions:
    """How the file of a shape is read."""

    parents: Parents = None
    package_dir: PackageDir = None
    free_base: FreeBase = None
    skin: Skin = None

    def given(self) -> dict[str, Any]:
        """Return the options that are given, by name."""
        values = {
            "--parents": self.parents, "--package-dir": self.package_dir or None,
            "--free-base/--fixed-base": self.free_base, "--skin": self.skin,
        }  # fmt: skip
        return {name: value for name, value in values.items() if value is not None}

    def load(self, name: str) -> ArticulatedShape:
        """Return the shape of a name or file; InputError if an option has no meaning for its kind."""
        ending = Path(name).suffix.lower()
        rigs = {"--parents", "--skin"}
        uses = {".urdf": {"--package-dir", "--free-base/--fixed-base"}, ".glb": rigs, ".gltf": rigs}
        if name not in HANDS and name not in PEOPLE and ending not in uses:
            raise InputError(
                f"SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf, or one of "
                f"{', '.join(PEOPLE)}; got {name!r}; {near_shape(name)}"
            )
        for option in self.given():
            if option not in uses.get(ending, set()):
                raise InputError(f"{option} has no meaning for {name}; leave it out")
        if name in HANDS:
            from torchreg.shapes.hand import Hand

            return Hand(HANDS[name])
        from torchreg.shapes.articulated import ArticulatedShape

        if name in PEOPLE:
            return ArticulatedShape.from_anny(PEOPLE[name])
        if ending == ".urdf":
            folders, free = self.package_dir or (), self.free_base is not False
            return ArticulatedShape.from_urdf(name, package_dirs=folders, free_base=free)
        joined = None if self.parents is None else _read_parents(self.parents)
        return ArticulatedShape.from_gltf(name, parents=joined, skin=chosen_skin(self.skin))


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
