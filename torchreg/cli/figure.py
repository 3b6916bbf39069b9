"""``torchreg figure``: pictures of the paper and of the README."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from torchreg.cli.outputs import PICTURE_ENDINGS, Force, Quiet, check_outputs, with_ending, written_to
from torchreg.cli.reporting import reporting


@reporting
def figure(
    name: Annotated[str, typer.Argument(metavar="bending|readme", help="Which picture to draw.")],
    output: Annotated[Path | None, written_to("OUT.png", "Where to (.png, .pdf, .svg); by default NAME.png.")] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Draw a picture: bending (the paper's figure 2, the skin at a = 2 and a = 10) or readme (start and alignment)."""
    from torchreg._checks import check_choice

    check_choice(name, "NAME", ("bending", "readme"))
    path = with_ending(output or Path(f"{name}.png"), PICTURE_ENDINGS)
    check_outputs([path], force)
    from torchreg.viz.figures import bending_picture, readme_picture

    written = bending_picture(path) if name == "bending" else readme_picture(path)
    if not quiet:
        typer.echo(f"wrote {written}")
