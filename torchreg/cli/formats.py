"""``torchreg formats``: what files are read."""

from __future__ import annotations

import typer

from torchreg.cli.reporting import reporting


@reporting
def formats() -> None:
    """Show the formats of files that are read, by what they hold.

    The content of a file decides on its format, or the ending where the content does not; clouds, meshes and their
    tables may be packed by gzip (.gz).
    """
    from torchreg.io.formats import KINDS, table_rows

    for kind in KINDS:
        typer.echo(f"{'' if kind == KINDS[0] else chr(10)}{kind}")
        for _, name, endings, holds, loader in (row for row in table_rows() if row[0] == kind):
            typer.echo(f"  {name}: {endings}\n    {holds} ({loader})")
