"""Commands that answer options which they do not have with those that were probably meant."""

from __future__ import annotations

import difflib
from typing import Any

from typer.core import TyperCommand

# What options are called elsewhere, in the library or in other programs.
_ELSEWHERE = {
    "--num-bones": "--bones", "--grid-resolution": "--grid", "--resolution": "--grid", "--num-tips": "--tips",
    "--num-samples": "--samples", "--out": "--output", "--output-dir": "--output", "--units": "--scale",
    "--unit": "--scale", "--camera": "--intrinsics", "--cameras": "--calibration", "--initial-pose": "--start",
    "--init": "--start",
    "--overwrite": "--force", "--threads": "--workers", "--jobs": "--workers", "--image": "--picture",
    "--standing": "--upright", "--masks": "--mask", "--resume": "--progress",
    "--progress": "--resume",
}  # fmt: skip
_EXPORTED = "torchreg export writes it from the result"
# What a command may well not have, and why.
_NOWHERE = {
    **dict.fromkeys(("--gif", "--mp4", "--video", "--glb", "--csv", "--obj", "--overlay"), _EXPORTED),
    "--seed": "nothing that this command draws at random is to be seeded: it gives the same result every time",
    "--device": "commands compute on the CPU; in Python, move shape and data with .to()",
    "--gpu": "commands compute on the CPU; in Python, move shape and data with .to()",
}


class Command(TyperCommand):
    """A command that names the option that was probably meant."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments of the command line."""
        known = [option for item in self.params for option in (*item.opts, *item.secondary_opts)]
        for word in args:
            if word == "--":
                break
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known and name != "--help":
                ctx.fail(f"No such option: {name}{_hint(name, known)}")
        return super().parse_args(ctx, args)


def _hint(name: str, known: list[str]) -> str:
    elsewhere = _ELSEWHERE.get(name)
    if elsewhere in known:
        return f"; did you mean {elsewhere}?"
    if name in _NOWHERE:
        return f"; {_NOWHERE[name]}"
    near = difflib.get_close_matches(name, known, 1, 0.7)
    return f"; did you mean {near[0]}?" if near else "; --help shows all"
