"""Messages of the library in the words of a command: its options in place of the arguments of functions."""

from __future__ import annotations

import re
from collections.abc import Iterable

# name=value, or name= alone, as messages name arguments.
_ARGUMENT = re.compile(r"\b([a-z_]+)=(\"[^\"]*\"|'[^']*'|\([^)]*\)|[\w.]+)?")
# Limits of files are arguments of functions only.
_LIMITS = re.compile(r";? ?if you trust it pass FileLimits\([^)]*(\.\.\.)?\)")
_OPTIONS = {"package_dirs": "--package-dir"}


def in_options(message: str, options: Iterable[str]) -> str:
    """Return a message with arguments of functions as options of a command, without hints that it cannot follow."""
    known = set(options)
    parts = _LIMITS.sub("", " ".join(message.split())).split("; ")
    translated = [part if (found := _translated(part, known)) is None else found for part in parts]
    kept = [part for part, words in zip(translated, parts, strict=True) if _can_be_followed(words, known)]
    return "; ".join(kept or translated)


def _option(name: str) -> str:
    return _OPTIONS.get(name, "--" + name.replace("_", "-"))


def _translated(part: str, known: set[str]) -> str | None:
    def option(found: re.Match[str]) -> str:
        name, value = _option(found[1]), (found[2] or "").strip("\"'")
        return found[0] if name not in known else f"{name} {value}".rstrip()

    return _ARGUMENT.sub(option, part)


def _can_be_followed(part: str, known: set[str]) -> bool:
    return all(_option(found[1]) in known for found in _ARGUMENT.finditer(part) if _is_argument(found[1]))


def _is_argument(name: str) -> bool:
    """Return whether a word before an equal sign is one of the library's arguments, not text of a file."""
    return name in _ARGUMENTS


# Arguments that messages ask for.
_ARGUMENTS = {
    "nan_policy", "skin", "parents", "package_dirs", "meshes", "scale", "time", "frame", "size", "unit", "axes",
    "config", "omit", "mask", "initial_pose", "mesh",
}  # fmt: skip
