"""Deformations of space by a few bones whose weights live on a sparse grid."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_choice,
    check_count,
    check_finite,
    check_positive,
    check_shape,
)
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import rescale_motions, transform_points
from torchreg.registration.blend import BLENDS, check_rigid_motions, turn_about
from torchreg.registration.bones.grid_lbs_record import GridLBSRecord
from torchreg.registration.bones.grid_module import GridModule, check_state, grid_of_state
from torchreg.registration.bones.joint_moments import NEGLIGIBLE, JointMoments, joint_moments
from torchreg.registration.bones.joints import REGULARIZATION, BoneTree, Joints, bone_tree, bridged, find_joints
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.solvers.simplex import nearest_on_simplex

# The entries of a model's state: what is learnt or set, then what tells the grid and the blend.
_STATE = (
    "weights", "twists", "middles", "base_transforms",
    "grid_cells", "grid_shape", "grid_origin", "grid_axes", "grid_spacing", "blend_number",
)  # fmt: skip


class GridLBS(GridModule):
    """Space that follows bones: ``D(x) = sum_j w_j(x) (R_j x + t_j)``, the weights interpolated on a sparse grid.

    Space without a cell has the weights of the nearest one, so that any point can be moved. Weights may take any
    values that are not negative: every row is divided by its sum where it is used. What an optimizer made of them,
    `project_` puts back on the simplex; see `RegistrationEnergy` for what to minimize.

    The bones' motions are stored as rigid matrices times twists about the bones' own middles. The twists are what an
    optimizer moves; they are zero after `set_transforms_`, so that no rotation is special.

    Args:
        grid: of the weights.
        weights: (K, B) at the corners of the grid, not negative, no row all zero; becomes a parameter.
        transforms: (..., B, 4, 4) rigid; a batch holds several poses; identities by default.
        blend: "linear", eq. 1; "dual_quaternion" moves every point rigidly, which keeps twisted limbs from collapsing.

    Attributes:
        weights: (K, B) parameter.
        twists: (..., B, 6) parameter, translation and rotation, see `turn_about`.

    Raises:
        InputError: if a shape does not fit, a number is not finite, weights are negative or a row of them is zero, or a
            transform is not rigid.

    References: Chang and Zwicker 2009, eq. 1 and section 3; Kavan et al. 2007 for the dual quaternions.
    """

    weights: Tensor
    twists: Tensor
    base_transforms: Tensor
    middles: Tensor

    def __init__(
        self, grid: SparseGrid, weights: Tensor, transforms: Tensor | None = None, *, blend: str = "linear"
    ) -> None:
        super().__init__(grid)
        check_choice(blend, "blend", tuple(BLENDS))
        weights = as_float_tensor(weights, "weights", like=grid.origin).detach()
        check_shape(weights, "weights", (grid.num_corners, "B"))
        check_finite(weights, "weights")
        if weights.shape[1] < 1 or bool((weights < 0).any()) or bool((weights.sum(-1) <= 0).any()):
            raise InputError("weights must not be negative, and every row must have a positive entry")
        self.blend = blend
        self.weights = nn.Parameter(weights.clone())
        self.register_buffer("middles", self._weighted_middles(grid), persistent=True)
        self.register_buffer("base_transforms", torch.eye(4).to(weights).repeat(weights.shape[1], 1, 1))
        self.twists = nn.Parameter(weights.new_zeros(weights.shape[1], 6))
        if transforms is not None:
            self.set_transforms_(transforms)

    @classmethod
    def from_labels(
        cls,
        grid: SparseGrid,
        labels: Tensor,
        num_bones: int,
        transforms: Tensor | None = None,
        *,
        blend: str = "linear",
    ) -> GridLBS:
        """Return the model in which every cell follows one bone; corners between cells of different bones share them.

        Args:
            grid: of the weights.
            labels: (C,) integers, the bone of each cell.
            num_bones: B.
            transforms: see `GridLBS`.
            blend: see `GridLBS`.

        Raises:
            InputError: if a label is out of range or a shape does not fit.
            InputTypeError: if labels are not integers.

        References: Chang and Zwicker 2009, eq. 12.
        """
        check_count(num_bones, "num_bones", 1)
        labels = as_tensor(labels, "labels", "integers").to(grid.cells.device)
        if labels.is_floating_point() or labels.is_complex() or labels.dtype == torch.bool:
            raise InputTypeError(f"labels must hold integers, got {labels.dtype}")
        check_shape(labels, "labels", (grid.num_cells,))
        if not 0 <= int(labels.min()) <= int(labels.max()) < num_bones:
            raise InputError(
                f"labels must be 0 to {num_bones - 1}, got {int(labels.min())} to {int(labels.max())}; raise num_bones"
            )
        per_cell = nn.functional.one_hot(labels.long(), num_bones).to(grid.origin)
        return cls(grid, grid.spread_to_corners(per_cell), transforms, blend=blend)

    @classmethod
    def from_record(cls, record: GridLBSRecord) -> GridLBS:
        """Return the model that a record describes.

        Raises:
            InputError: if it describes none.
        """
        grid = SparseGrid.from_cells(record.cells, record.shape, record.origin, record.axes, record.spacing)
        return cls(grid, record.weights, record.transforms, blend=record.blend)

    def record(self) -> GridLBSRecord:
        """Return the model as plain data; its tensors are detached, on the CPU and not shared with the model."""

        def plain(value: Tensor) -> Tensor:
            return value.detach().cpu().clone()

        grid = self.grid
        return GridLBSRecord(
            cells=plain(grid.cells),
            shape=grid.shape,
            origin=plain(grid.origin),
            axes=plain(grid.axes),
            spacing=grid.spacing,
            weights=plain(self.weights),
            transforms=plain(self.transforms),
            blend=self.blend,
        )

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Tensor]) -> GridLBS:
        """Return the model of a ``state_dict()``, on its device and in its dtype; it moves points to the same bits.

        Args:
            state: of a `GridLBS`, whole; ``load_state_dict`` reads it into a model of the same grid.

        Raises:
            InputError: if an entry is missing, unknown, not finite or of a shape that does not fit.
            InputTypeError: if the state is no mapping, or an entry no tensor.
        """
        check_state(state, _STATE, "GridLBS")
        weights, motions = state["weights"], state["base_transforms"]
        check_shape(weights, "weights", ("K", "B"))
        check_shape(state["twists"], "twists", (*motions.shape[:-2], 6))
        check_shape(state["middles"], "middles", (weights.shape[1], 3))
        check_shape(state["blend_number"], "blend_number", ())
        number, names = int(state["blend_number"]), tuple(BLENDS)
        if number not in range(len(names)):
            raise InputError(f"blend_number must be from 0 to {len(names) - 1}, got {number}; is the state newer?")
        # Weights that are being optimized may be negative for a while: only their shape is checked.
        model = cls(grid_of_state(state), torch.ones_like(weights), motions, blend=names[number])
        model.load_state_dict(state)
        return model

    def _numbers(self) -> dict[str, Tensor]:
        return super()._numbers() | {"blend_number": torch.tensor(tuple(BLENDS).index(self.blend))}

    def _set_numbers(self, numbers: Mapping[str, Tensor]) -> None:
        super()._set_numbers(numbers)
        self.blend = tuple(BLENDS)[int(numbers["blend_number"])]

    def rescaled(self, scale: float, origin: Tensor) -> GridLBS:
        """Return the same model, without gradients, in the coordinates ``x' = origin + scale x``.

        Args:
            scale: positive.
            origin: (3,) of the old coordinates, in the new ones.
        """
        grid, transforms = self.grid, rescale_motions(self.transforms.detach(), scale, origin)
        scaled = SparseGrid(grid.cells, grid.shape, origin + scale * grid.origin, grid.axes, scale * grid.spacing)
        return GridLBS(scaled, self.weights.detach(), transforms, blend=self.blend)

    def extra_repr(self) -> str:
        """Return the settings for the module's printed form."""
        return f"{self.num_bones} bones, {len(self.grid_cells)} cells of {self._spacing:.4g}, blend={self.blend!r}"

    @property
    def num_bones(self) -> int:
        """B."""
        return self.weights.shape[1]

    @property
    def transforms(self) -> Tensor:
        """The bones' motions (..., B, 4, 4). Differentiable: in ``twists``."""
        return turn_about(self.base_transforms, self.twists, self._centers(self.base_transforms))

    @torch.no_grad()
    def set_transforms_(self, transforms: Tensor) -> GridLBS:
        """Put the bones at rigid motions (..., B, 4, 4), with zero twists, and return the model.

        With other batch dimensions than before, ``twists`` becomes a new parameter.

        Raises:
            InputError: if a shape does not fit, a number is not finite, or a transform is not rigid.
        """
        transforms = as_float_tensor(transforms, "transforms", like=self.weights).detach()
        check_shape(transforms, "transforms", (self.num_bones, 4, 4), batch=True)
        check_rigid_motions(transforms, "transforms")
        if transforms.shape != self.base_transforms.shape:
            self.twists = nn.Parameter(transforms.new_zeros(*transforms.shape[:-2], 6), self.twists.requires_grad)
        self.base_transforms = transforms.clone()
        self.twists.zero_()
        return self

    @torch.no_grad()
    def project_(self) -> GridLBS:
        """Put every row of the weights on the simplex, at the nearest point of it, and return the model.

        ``v_c <- argmin_{x >= 0, sum x = 1} |x - v_c|^2``, non-negative least squares, also for rows that are zero,
        negative or large. With this after every step, an optimizer moves the weights by projected gradients.

        Raises:
            InputError: if a weight is not finite.
        """
        check_finite(self.weights, "weights", "take smaller steps, and look at what the loss holds")
        self.weights.copy_(nearest_on_simplex(self.weights))
        return self

    def forward(self, points: Tensor, transforms: Tensor | None = None) -> Tensor:
        """Return points (..., N, 3) of the space moved by the bones.

        Args:
            points: (..., N, 3) in the dtype of the model.
            transforms: (..., B, 4, 4) a pose to use instead of the model's own; batch dimensions broadcast with those
                of the points.

        Differentiable: in ``points`` within cells, ``transforms``, ``twists`` and ``weights``.

        Cost: 6 ms for 10,000 points and 10 bones on one core.

        References: Chang and Zwicker 2009, eq. 1.
        """
        return self.move(points, self.weights_at(points), transforms)

    def move(self, points: Tensor, weights: Tensor, transforms: Tensor | None = None) -> Tensor:
        """Return points (..., N, 3) of weights (..., N, B) moved by the bones; arguments else as of `forward`.

        Differentiable: in all, and ``twists``.
        """
        blend, _ = BLENDS[self.blend]
        return blend(points, weights, self.transforms if transforms is None else transforms)

    def weights_at(self, points: Tensor) -> Tensor:
        """Return the bones' weights (..., N, B) at points (..., N, 3); rows sum to one.

        Differentiable: in ``points`` within cells, and ``weights``.
        """
        location = self.locate(points)
        index = self._cell_corners[location.cell]
        # Three times as fast as indexing.
        corner = self.corner_weights().index_select(0, index.flatten()).unflatten(0, index.shape)
        return (location.coefficients.unsqueeze(-2) @ corner).squeeze(-2)

    def corner_weights(self) -> Tensor:
        """Return the weights (K, B) at the corners, rows divided by their sums. Differentiable: in ``weights``."""
        total = self.weights.sum(-1, keepdim=True)
        return self.weights / total.clamp_min(torch.finfo(total.dtype).tiny)

    @torch.no_grad()
    def vertex_weights(self, points: Tensor, *, most: int | None = None) -> Tensor:
        """Return skinning weights (..., N, B) of points (..., N, 3), for other programs; rows sum to one.

        Args:
            points: (..., N, 3).
            most: keep that many of the largest weights of each point, four in many file formats; all by default.

        Raises:
            InputError: if ``most`` is below one.
        """
        weights = self.weights_at(points)
        if most is None or most >= self.num_bones:
            return weights
        check_count(most, "most", 1)
        largest, index = weights.topk(most, dim=-1)
        kept = torch.zeros_like(weights).scatter(-1, index, largest)
        return kept / kept.sum(-1, keepdim=True)

    def jacobian(self, points: Tensor, transforms: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return moved points (..., N, 3) and their derivatives (..., N, 3, B, 6) by twists of the bones.

        Convention: a twist (translation, rotation) of bone j is applied on top of its motion, about the image of
        ``middles[j]``, see `turn_about`.

        Args:
            points: see `forward`.
            transforms: see `forward`.

        Differentiable: in all.
        """
        transforms = self.transforms if transforms is None else transforms
        weights = self.weights_at(points)
        blend, jacobian = BLENDS[self.blend]
        return blend(points, weights, transforms), jacobian(points, weights, transforms, self._centers(transforms))

    def joint_moments(self, *, min_mass: float = NEGLIGIBLE.mass, pairs: Tensor | None = None) -> JointMoments:
        """Return the moments of what bones share, over the whole grid; see `joint_moments.joint_moments`."""
        check_positive(min_mass, "min_mass")
        return joint_moments(self.grid, self.corner_weights(), min_mass=min_mass, pairs=pairs)

    def joints(
        self,
        transforms: Tensor | None = None,
        *,
        min_mass: float = NEGLIGIBLE.mass,
        regularization: float = REGULARIZATION.found,
    ) -> Joints:
        """Return the joints of the bones, in the space of the points before they are moved.

        Of bones that share weight, and where hidden joints cut the points in pieces, of those that `bridged` finds.

        Args:
            transforms: (..., B, 4, 4) poses to estimate the joints from, all together; the model's own by default.
            min_mass: pairs that share less than this share of a cell are left out.
            regularization: see `find_joints`.

        Raises:
            InputError: if a number is not positive or a shape does not fit.

        Differentiable: in ``transforms`` and ``twists``.
        """
        moments = self.bridged_moments(transforms, min_mass=min_mass, regularization=regularization)
        return self.joints_of(moments, transforms, regularization=regularization)

    @torch.no_grad()
    def bridged_moments(
        self,
        transforms: Tensor | None = None,
        *,
        min_mass: float = NEGLIGIBLE.mass,
        regularization: float = REGULARIZATION.found,
    ) -> JointMoments:
        """Return the moments of what bones share, and of pairs that join separate pieces; arguments as of `joints`.

        Differentiable: no.
        """
        transforms = self.pose(transforms)
        check_positive(regularization, "regularization")
        moments, corners = self.joint_moments(min_mass=min_mass), self.grid.corner_points()
        return bridged(moments, corners, self.corner_weights(), transforms, regularization=regularization)

    def joints_of(
        self, moments: JointMoments, transforms: Tensor | None = None, *, regularization: float = REGULARIZATION.found
    ) -> Joints:
        """Return the joints of moments that are known already; arguments else as of `joints`."""
        check_positive(regularization, "regularization")
        return find_joints(moments, self.pose(transforms), regularization=regularization)

    @torch.no_grad()
    def skeleton(self, transforms: Tensor | None = None, *, min_mass: float = NEGLIGIBLE.mass) -> BoneTree:
        """Return the tree of the strongest joints; its root is the heaviest bone; a bone without weight is one alone.

        Args:
            transforms: see `joints`.
            min_mass: see `joints`.
        """
        joints = self.joints(transforms, min_mass=min_mass)
        return bone_tree(joints, self._weighted_middles(self.grid), self.corner_weights().sum(0))

    def pose(self, transforms: Tensor | None) -> Tensor:
        """Return given motions (..., B, 4, 4), or the model's own."""
        if transforms is None:
            return self.transforms
        check_shape(transforms, "transforms", (self.num_bones, 4, 4), batch=True)
        return transforms

    @torch.no_grad()
    def _weighted_middles(self, grid: SparseGrid) -> Tensor:
        """Return the mean positions (B, 3) of the bones' weights; of a bone without any, that of the grid."""
        corners, share = grid.corner_points(), self.corner_weights()
        total = share.sum(0).unsqueeze(-1)
        origin = corners.mean(0)
        return origin + torch.where(total > 0, (share.mT @ (corners - origin)) / total.clamp_min(1e-30), 0.0)

    def _centers(self, transforms: Tensor) -> Tensor:
        return transform_points(transforms, self.middles.unsqueeze(-2)).squeeze(-2)
