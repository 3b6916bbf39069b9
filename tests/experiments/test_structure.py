from dataclasses import dataclass, field
from typing import Literal

import pytest

from experiments.errors import ConfigError
from experiments.structure import build, flatten, plain, updated


@dataclass(frozen=True)
class Inner:
    size: int = 3
    width: float = 1.0
    kind: Literal["a", "b"] = "a"

    def __post_init__(self):
        if self.size < 0:
            raise ValueError("size must not be negative")


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=Inner)
    ratio: float | None = None
    values: tuple[float, ...] = ()
    on: bool = False
    extra: dict[str, object] = field(default_factory=dict)


def test_plain_data_become_dataclasses_and_come_back():
    data = {"name": "x", "inner": {"size": 4, "kind": "b"}, "ratio": 2, "values": [1, 2.5], "on": True}
    found = build(Outer, data)
    assert found == Outer("x", Inner(4, 1.0, "b"), 2.0, (1.0, 2.5), True)
    assert isinstance(found.ratio, float)
    assert isinstance(found.values[0], float)
    assert build(Outer, plain(found)) == found
    assert flatten(plain(found))["inner.size"] == 4


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            {"name": "x", "inner": {"sizes": 4}},
            r"unknown key inner.sizes; known keys of inner: kind, size, width; .*size",
        ),
        ({"nam": "x"}, r"unknown key nam; known keys: extra, inner, name, on, ratio, values; did you mean name\?"),
        ({}, "name is missing"),
        ({"name": 3}, "name must be a text, got int 3"),
        ({"name": "x", "inner": {"size": "4"}}, "inner.size must be an integer, got str '4'"),
        ({"name": "x", "inner": {"size": True}}, "inner.size must be an integer, got bool True"),
        ({"name": "x", "inner": {"size": 1.5}}, "inner.size must be an integer, got float 1.5"),
        ({"name": "x", "inner": {"kind": "c"}}, "inner.kind must be one of a, b, got str 'c'"),
        ({"name": "x", "inner": 3}, "inner must be a mapping, got int 3"),
        ({"name": "x", "inner": {"size": -1}}, "inner.size must not be negative"),
        ({"name": "x", "ratio": "many"}, "ratio must be a number, got str 'many'"),
        ({"name": "x", "ratio": float("nan")}, "ratio must be finite"),
        ({"name": "x", "values": 3}, "values must be a list, got int 3"),
        ({"name": "x", "values": [1, "b"]}, r"values\[1\] must be a number, got str 'b'"),
        ({"name": "x", "on": 1}, "on must be true or false, got int 1"),
        ({"name": "x", "extra": []}, "extra must be a mapping"),
        ([1], "the configuration must be a mapping"),
    ],
)
def test_what_is_wrong_is_named(data, message):
    with pytest.raises(ConfigError, match=message):
        build(Outer, data)


def test_fields_are_changed_by_dotted_keys():
    assert updated(Outer("x"), {"inner.size": 7, "ratio": 1}) == Outer("x", Inner(7), 1.0)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("inner.sizes", r"unknown key trial.inner.sizes; known keys of trial.inner: kind, size, width"),
        ("other.size", r"unknown key trial.other; known keys of trial: extra, inner"),
        ("name.size", r"unknown key trial.name.size"),
    ],
)
def test_dotted_keys_must_lead_to_a_field(key, message):
    with pytest.raises(ConfigError, match=message):
        updated(Outer("x"), {key: 1})
