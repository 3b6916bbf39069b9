"""The base of all results: frozen records of tensors that print in one line and save themselves."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from enum import Enum
from html import escape
from importlib import import_module
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

Record = TypeVar("Record")


def public(name: str) -> Any:
    """Return the object of a public name of the library, the only way from this module to the rooms above."""
    return getattr(import_module("torchreg"), name)


def stored_as(to_record: Callable[[Any], Any], from_record: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the metadata of a result's field that is not plain data, such as a module.

    Args:
        to_record: from its value to a dataclass of tensors and plain data, annotated with that class.
        from_record: the inverse.
    """
    return {"to_record": to_record, "from_record": from_record}


def formerly(name: str) -> dict[str, Any]:
    """Return the metadata of a field that files of earlier releases hold under another name."""
    return {"formerly": name}


def _field_summary(value: Any) -> str:
    """Return a field's value in few words."""
    if isinstance(value, Tensor):
        if value.numel() == 1 and not value.is_complex():
            return f"{value.item():.4g}"
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, tuple):
        words = [str(item.value) if isinstance(item, Enum) else item for item in value if isinstance(item, (Enum, str))]
        kinds = sorted(set(words))
        if len(words) < len(value) or len(kinds) > _MAX_KINDS:
            return f"{len(value)} x {type(value[0]).__name__}"
        return ", ".join(f"{words.count(kind)} {kind}" for kind in kinds) or "none"
    if isinstance(value, (Result, nn.Module)):
        return type(value).__name__
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# Different words in a tuple up to which each is printed with its count.
_MAX_KINDS = 6


class Result:
    """The result of a pipeline: a frozen record that can be saved.

    It prints in one line, and in notebooks as a table: tensors by type and shape, not by their numbers.
    """

    # Dimensions of fields by name, as "T K 3"; leading dimensions of a batch are the same for all.
    shapes: ClassVar[Mapping[str, str]] = {}

    def shape_defect(self) -> str | None:
        """Return which field does not fit the shapes of the others, in words; None if all do."""
        sizes: dict[str, int] = {}
        batches: dict[str, tuple[int, ...]] = {}
        for name, dimensions in self.shapes.items():
            value, wanted = getattr(self, name), dimensions.split()
            if value is None:
                continue
            shape = (len(value),) if isinstance(value, tuple) else tuple(value.shape)
            if len(shape) < len(wanted):
                return f"{name} must have shape ({', '.join(wanted)}), got {shape}"
            split = len(shape) - len(wanted)
            batches[name] = shape[:split]
            for label, size in zip(wanted, shape[split:], strict=True):
                if sizes.setdefault(label, int(label) if label.isdecimal() else size) != size:
                    return f"{name} must have shape ({', '.join(wanted)}) with {label} = {sizes[label]}, got {shape}"
        if len(set(batches.values())) > 1:
            return f"{', '.join(batches)} must have the same leading dimensions, got {set(batches.values())}"
        status = getattr(self, "status", None)
        batch = next(iter(batches.values()), ())
        if isinstance(status, tuple) and batch != (len(status),):
            return f"status must be one, or one per row of the batch {batch}, got {len(status)}"
        return None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # @dataclass does not replace a __repr__ that the class has already.
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        parts = ", ".join(f"{name}={text}" for name, text in self._summaries())
        return f"{type(self).__name__}({parts})"

    def _repr_html_(self) -> str:
        """Return a table of the fields, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in self._summaries()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"

    def _summaries(self) -> list[tuple[str, str]]:
        values = ((item.name, getattr(self, item.name)) for item in fields(self))  # type: ignore[arg-type]
        return [(name, _field_summary(value)) for name, value in values if value is not None]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to ``path``, which ends in .safetensors, and a JSON file beside it.

        `torchreg.load` reads it back with every field as it was, on the CPU and without gradients.

        Args:
            path: a local file ending in .safetensors; an existing pair is replaced, each file whole or not at all.

        Raises:
            InputError: if the path has another ending.
            InputTypeError: if a field holds something that cannot be stored.
            FileNotFoundError: if the folder does not exist.
        """
        # Files belong to a room above this one.
        import_module(public("load").__module__).save_result(self, path)


class Status(Enum):
    """The outcome of a pipeline."""

    CONVERGED = "converged"
    MAX_STEPS = "max_steps"
    WITH_WARNINGS = "with_warnings"
    FEW_INLIERS = "few_inliers"
    NO_DATA = "no_data"
    LOST = "lost"
    OTHER_UNITS = "other_units"
    DOUBTFUL = "doubtful"  # a result that its own evidence speaks against
    DEGENERATE = "degenerate"  # data at one place, on a line or on a plane, which determine no pose

    @property
    def usable(self) -> bool:
        """Whether the result rests on data that support it, converged or not."""
        return self in (Status.CONVERGED, Status.MAX_STEPS, Status.WITH_WARNINGS)


def normal_copy(record: Record) -> Record:
    """Return a copy of a dataclass with tensors that autograd accepts, unlike those made in inference mode."""
    values = {item.name: getattr(record, item.name) for item in fields(record)}  # type: ignore[arg-type]
    with torch.inference_mode(False), torch.no_grad():
        copies = {name: value.clone() for name, value in values.items() if isinstance(value, Tensor)}
    return replace(record, **copies)  # type: ignore[type-var]
