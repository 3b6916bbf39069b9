"""Modules over a sparse grid, which is part of their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchreg._checks import check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.registration.bones.sparse_grid import GridLocation, SparseGrid, locate_in_cells


class GridModule(nn.Module):
    """A module that holds a sparse grid, which is part of its ``state_dict()``.

    Shape and spacing are Python numbers, so that the module can be compiled and no cast rounds them. States without
    entries of the grid, saved before grids were part of them, are taken as being of this grid.
    """

    grid_origin: Tensor
    grid_axes: Tensor
    grid_cells: Tensor
    _cell_corners: Tensor
    _nearest: Tensor

    def __init__(self, grid: SparseGrid) -> None:
        super().__init__()
        self._shape, self._spacing = grid.shape, grid.spacing
        for name, value in (("origin", grid.origin), ("axes", grid.axes), ("cells", grid.cells)):
            self.register_buffer(f"grid_{name}", value.detach().clone())
        # These follow from the cells.
        self.register_buffer("_cell_corners", grid.cell_corners.clone(), persistent=False)
        self.register_buffer("_nearest", grid.nearest.clone(), persistent=False)

    @property
    def grid(self) -> SparseGrid:
        """The grid, on the device and in the dtype of the module."""
        return SparseGrid(self.grid_cells, self._shape, self.grid_origin, self.grid_axes, self._spacing)

    def locate(self, points: Tensor) -> GridLocation:
        """Return cells and coefficients of points (..., N, 3), as `SparseGrid.locate` does, from tables at hand."""
        coordinates = ((points - self.grid_origin) @ self.grid_axes) / self._spacing
        return locate_in_cells(coordinates, self._shape, self.grid_cells, self._nearest)

    def _numbers(self) -> dict[str, Tensor]:
        """Return the entries of the state that are Python numbers here."""
        return {
            "grid_shape": torch.tensor(self._shape),
            "grid_spacing": torch.tensor(self._spacing, dtype=torch.float64),
        }

    def _set_numbers(self, numbers: Mapping[str, Tensor]) -> None:
        """Take over what `_numbers` returned for the same cells."""
        self._spacing = float(numbers["grid_spacing"])

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        destination.update({prefix + name: value for name, value in self._numbers().items()})

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        numbers = self._numbers()
        buffers = {name: getattr(self, name) for name in ("grid_cells", "grid_origin", "grid_axes")}
        if not any(prefix + name in state_dict for name in (*numbers, *buffers)):
            state_dict.update({prefix + name: value for name, value in (numbers | buffers).items()})
        missing_keys += [prefix + name for name in numbers if prefix + name not in state_dict]
        numbers |= {name: state_dict.pop(prefix + name) for name in numbers if prefix + name in state_dict}
        cells = state_dict.get(prefix + "grid_cells", self.grid_cells).to(self.grid_cells)
        if numbers["grid_shape"].tolist() != list(self._shape) or not torch.equal(cells, self.grid_cells):
            error_msgs.append(f"{prefix}grid_cells are of another grid; use {type(self).__name__}.from_state_dict")
            return
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )
        self._set_numbers(numbers)


def check_state(state: Any, names: Sequence[str], kind: str) -> None:
    """Raise unless a state holds finite tensors of these names, those of a kind of module, and nothing else."""
    if not isinstance(state, Mapping):
        raise InputTypeError(f"state must be the state_dict() of a {kind}, got {type(state).__name__}")
    missing = [name for name in names if name not in state]
    unknown = [str(name) for name in state if name not in names]
    if missing or unknown:
        faults = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has {', '.join(unknown)}"] * bool(unknown)
        raise InputError(
            f"state must be the state_dict() of a {kind}, got one that {' and '.join(faults)}; "
            f"of a larger module, pass the entries of its {kind} alone, without their prefix"
        )
    for name in names:
        if not isinstance(state[name], Tensor):
            raise InputTypeError(f"state must hold tensors, got {type(state[name]).__name__} as {name}")
        check_finite(state[name], name)


def grid_of_state(state: Mapping[str, Tensor]) -> SparseGrid:
    """Return the grid of a state that `check_state` passes."""
    check_shape(state["grid_shape"], "grid_shape", (3,))
    check_shape(state["grid_spacing"], "grid_spacing", ())
    return SparseGrid.from_cells(
        state["grid_cells"],
        tuple(int(count) for count in state["grid_shape"].tolist()),
        state["grid_origin"],
        state["grid_axes"],
        float(state["grid_spacing"]),
    )
