"""The base of all results: frozen records of tensors that print in one line and save themselves."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from html import escape
from importlib import import_module
from typing import Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor, nn

Record = TypeVar("Record")


def public(name: str) -> Any:
    """Return the object of a public name of the library, the only way from this module to the rooms above."""
    return getattr(import_module("torchreg"), name)


def stored_as(to_record: Callable[[Any], Any], from_record: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the metadata of a field that is not plain data: functions to an annotated dataclass of it, and back."""
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


def _moved(value: Any, device: torch.device | str | None, dtype: torch.dtype | None) -> Any:
    """Return a value whose tensors, however deep, are on a device, and those of floating point of a dtype."""
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, nn.Module):
        return copy.deepcopy(value).to(device=device, dtype=dtype)
    if isinstance(value, tuple):
        return tuple(_moved(item, device, dtype) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{item.name: _moved(getattr(value, item.name), device, dtype) for item in fields(value)})
    return value


def _plain(value: Any, of_tensor: Callable[[Tensor], Any]) -> Any:
    """Return a value as dictionaries, lists, numbers and words; modules become None."""
    if isinstance(value, Tensor):
        return of_tensor(value.detach().cpu())
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (tuple, list)):
        return [_plain(item, of_tensor) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item, of_tensor) for key, item in value.items()}
    if is_dataclass(value):
        found = {item.name: _plain(getattr(value, item.name), of_tensor) for item in fields(value)}
        return {name: entry for name, entry in found.items() if entry is not None}
    return None if isinstance(value, nn.Module) else value


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
        parts = ", ".join(f"{name}={text}" for name, text in self.summary())
        return f"{type(self).__name__}({parts})"

    def _repr_html_(self) -> str:
        """Return a table of the fields, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in self.summary()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"

    def summary(self) -> list[tuple[str, str]]:
        """Return names and few words of the fields that are not None, as they are printed."""
        values = ((item.name, getattr(self, item.name)) for item in fields(self))  # type: ignore[arg-type]
        return [(name, _field_summary(value)) for name, value in values if value is not None]

    def to(self, device: torch.device | str | torch.dtype | None = None, dtype: torch.dtype | None = None) -> Self:
        """Return the result with all tensors on a device and those of floating point in a dtype, as `Tensor.to` does.

        Args:
            device: such as "cpu" or "cuda"; or a dtype alone.
            dtype: of numbers in floating point; whole numbers and masks keep theirs.
        """
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        moved: Self = _moved(self, device, dtype)
        return moved

    def numpy(self) -> dict[str, Any]:
        """Return the fields by name: arrays for tensors, words for statuses, dictionaries for records inside.

        Fields that are None, and shapes, are left out.
        """
        found: dict[str, Any] = _plain(self, Tensor.numpy)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name in plain Python: lists of numbers, words, dictionaries; what `json.dumps` takes.

        Fields that are None, and shapes, are left out. NaN stays NaN, which strict JSON does not know.
        """
        found: dict[str, Any] = _plain(self, Tensor.tolist)
        return found

    def plot(self, data: Any = None, **options: Any) -> Any:
        """Return matplotlib axes with a picture of the result; see `torchreg.plot`.

        Args:
            data: what was measured: a cloud or mesh, or one per frame.
            options: of `torchreg.plot`.
        """
        return public("plot")(self, data, **options)

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
    NOT_FOUND = "not_found"  # in a picture or a sequence: it is not there, or the search missed it
    DOUBTFUL = "doubtful"  # a result that its own evidence speaks against
    DEGENERATE = "degenerate"  # data at one place, on a line or on a plane, which determine no pose

    def __str__(self) -> str:
        """Return the one spelling that files, pages and the command line have too."""
        return str(self.value)

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
