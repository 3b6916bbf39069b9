"""The option of what scanned things stand on."""

from __future__ import annotations

from typing import Annotated

import typer

Support = Annotated[
    str, typer.Option(help="A table or a floor that the scanned thing stands on: auto leaves it out, keep keeps it.")
]
