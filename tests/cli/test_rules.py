"""The rules that all commands keep: what an option means, how outputs are named, what every help ends with."""

import typing
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from types import NoneType

import pytest
from typer.models import OptionInfo

from torchreg.cli.application import _COMMANDS
from torchreg.cli.near_options import _ELSEWHERE

# What may be given twice where there is a source and a target, and how a track names its movie in one word.
TWICE = {"--scale", "--time", "--frame", "--intrinsics"}
WORDS = {"--movie"}
# Commands that read scans or shapes of users and draw them, or write them for viewers.
DRAWING = {"align", "track", "register", "spine", "pose", "view"}
EXAMPLES = {function.__name__.replace("_", "-"): examples for function, _, examples in _COMMANDS}


@dataclass
class Option:
    names: tuple
    kind: object
    many: bool
    info: OptionInfo


def options_of(function):
    for name, hint in typing.get_type_hints(function, include_extras=True).items():
        info = next((item for item in getattr(hint, "__metadata__", ()) if isinstance(item, OptionInfo)), None)
        if info is not None:
            first = [info.default] if str(info.default).startswith("-") else []  # where the first name ends up
            given = [word for names in (*first, *(info.param_decls or ())) for word in names.split("/")]
            kinds = set(typing.get_args(hint.__origin__) or [hint.__origin__]) - {NoneType}
            (kind,) = kinds if len(kinds) == 1 else [tuple]
            many = typing.get_origin(kind) is list
            names = tuple(given or ["--" + name.replace("_", "-")])
            yield Option(names, typing.get_args(kind)[0] if many else kind, many, info)


OPTIONS = {function.__name__.replace("_", "-"): list(options_of(function)) for function, _, _ in _COMMANDS}


def by_name():
    found = defaultdict(dict)
    for command, rows in OPTIONS.items():
        for item in rows:
            for name in item.names:
                found[name][command] = item
    return found


def names_of(command):
    return {name for item in OPTIONS[command] for name in item.names}


def test_an_option_is_of_one_kind_everywhere():
    """Flag here and path there, or several values here and one there, is what users stumble over."""
    for name, items in by_name().items():
        kinds = {item.kind for item in items.values()}
        assert len(kinds) == 1 or (name in WORDS and kinds == {str, Path}), (name, kinds)
        assert len({item.many for item in items.values()}) == 1 or name in TWICE, name


def test_an_option_has_one_help_everywhere():
    for name in ("--up", "--force", "--quiet", "--seen", "--mask", "--depth", "--port", "--scale", "--nan-policy"):
        told = {item.info.help for item in by_name()[name].values() if not item.many}
        assert len(told) == 1, told


def test_what_draws_can_be_told_what_is_upright():
    assert set(by_name()["--up"]) == DRAWING


@pytest.mark.parametrize("command", OPTIONS)
def test_what_writes_names_its_output_and_is_quiet_when_asked(command):
    if command in ("formats", "info"):
        assert not names_of(command) & {"--output", "--force"}
        return
    assert {"--output", "-o", "--quiet"} <= names_of(command)
    assert ("--force" in names_of(command)) == (command != "train-initializer")  # it goes on with what is there
    output = by_name()["-o"][command].info.metavar
    assert output == "RESULT" or output.startswith(("OUT.", "FOLDER"))


@pytest.mark.parametrize("command", OPTIONS)
def test_help_is_in_sentences_and_its_two_examples_are_right(command):
    for item in OPTIONS[command]:
        assert (item.info.help or "").endswith((".", ")")), item.names
    assert len(EXAMPLES[command]) == 2
    for example in EXAMPLES[command]:
        words = example.partition(" | ")[0].split()
        assert words[0] == command
        assert {word for word in words if word.startswith("-")} <= names_of(command)


def test_hints_lead_to_options_that_exist():
    assert set(_ELSEWHERE.values()) <= set(by_name())
