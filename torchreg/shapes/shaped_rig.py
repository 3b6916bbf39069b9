"""Rigs with shape coefficients: made from arrays and files, and the rig of one person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import invert_rigid
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.shape_space import CoefficientPrior, FunctionSpace, LinearSpace, RestFunction, ShapeSpace
from torchreg.shapes.spec import RigSurface, ShapeSpec

ShapeDirs = Tensor | RestFunction


@dataclass(frozen=True)
class _Tolerances:
    """Tolerances of shape coefficients."""

    regressed: float = 0.02  # of the mesh's size, that joints may lie from where the regressor puts them
    min_owned: int = 8  # vertices by which a part's growth is measured


_TOLERANCES = _Tolerances()


@dataclass(frozen=True)
class Coefficients:
    """The arguments from which `ArticulatedShape.from_skinned_mesh` makes coefficients."""

    shape_dirs: ShapeDirs | None = None
    joint_dirs: Tensor | None = None
    joint_regressor: Tensor | None = None
    names: Sequence[str] | None = None
    std: Tensor | float = 1.0

    def space(
        self, tree: KinematicTree, vertices: Tensor, joints: Tensor, joint_names: Sequence[str]
    ) -> ShapeSpace | None:
        """Return the space of rest states of a rig, or None where there are no coefficients."""
        if self.shape_dirs is None:
            given = [name for name in ("joint_dirs", "joint_regressor", "names") if getattr(self, name) is not None]
            if given:
                raise InputError(f"{given[0].replace('names', 'coefficient_names')} needs shape_dirs; give both")
            return None
        owners = frame_joints(tree, joint_names)
        if callable(self.shape_dirs):
            return self._function_space(self.shape_dirs, vertices, joints, owners)
        dirs = _checked(self.shape_dirs, "shape_dirs", (len(vertices), 3, "K"))
        by_joint = self._joint_dirs(dirs, vertices, joints)
        prior = self._prior(dirs.shape[-1], "shape_dirs")
        return LinearSpace(vertices, dirs, joints[owners], by_joint[owners], prior)

    def _prior(self, count: int, source: str) -> CoefficientPrior:
        names = self.names if self.names is not None else [f"shape_{number}" for number in range(count)]
        if len(names) != count:
            raise InputError(f"{source} has {count} coefficients, but coefficient_names has {len(names)}")
        std = torch.as_tensor(self.std, dtype=torch.float64)
        if std.ndim > 1 or (std.ndim == 1 and len(std) != count) or not bool((std > 0).all() & std.isfinite().all()):
            raise InputError(f"coefficient_std must be one positive number, or one for each of {count}; got {self.std}")
        return CoefficientPrior.normal(names, std)

    def _joint_dirs(self, dirs: Tensor, vertices: Tensor, joints: Tensor) -> Tensor:
        """Return the directions (J, 3, K) of the joints: as given, or by the regressor."""
        if (self.joint_dirs is None) == (self.joint_regressor is None):
            raise InputError("shape_dirs need either joint_dirs (J, 3, K) or joint_regressor (J, V): joints move too")
        if self.joint_dirs is not None:
            return _checked(self.joint_dirs, "joint_dirs", (len(joints), 3, dirs.shape[-1]))
        regressor = _checked(self.joint_regressor, "joint_regressor", (len(joints), len(vertices)))
        off = (regressor @ vertices - joints).norm(dim=-1)
        size = float((vertices.amax(0) - vertices.amin(0)).norm())
        if float(off.max()) > _TOLERANCES.regressed * size:
            raise InputError(
                f"joint_regressor puts joint {int(off.argmax())} {float(off.max()):.3g} m from where joints has it; "
                f"give the regressor of these vertices, and joints = joint_regressor @ vertices"
            )
        return torch.einsum("jv,vck->jck", regressor, dirs)

    def _function_space(self, function: RestFunction, vertices: Tensor, joints: Tensor, owners: Tensor) -> ShapeSpace:
        if self.names is None:
            raise InputError("shape_dirs is a function: coefficient_names must say how many coefficients it takes")
        if self.joint_dirs is not None or self.joint_regressor is not None:
            raise InputError("shape_dirs is a function, which gives the joints too; leave joint_dirs and regressor out")
        prior = self._prior(len(self.names), "the function shape_dirs")
        found = function(prior.mean)
        for value, like, name in zip(found, (vertices, joints), ("vertices", "joints"), strict=True):
            check_shape(value, f"the {name} of shape_dirs(coefficients)", tuple(like.shape))
            check_finite(value, f"the {name} of shape_dirs(coefficients)")
        return FunctionSpace(function, owners, prior)


def _checked(value: object, name: str, shape: Sequence[int | str]) -> Tensor:
    tensor = as_float_tensor(value, name).double()
    check_shape(tensor, name, shape)
    check_finite(tensor, name)
    return tensor


def frame_joints(tree: KinematicTree, joint_names: Sequence[str]) -> Tensor:
    """Return the joint (F,) of the rig at which each frame of its tree lies."""
    owners: list[int] = []
    for joint in tree.joints:
        # The frames of a ball joint stand on the one that has the name of the rig's joint.
        owners.append(joint_names.index(joint.name) if joint.name in joint_names else owners[joint.parent])
    return torch.tensor(owners)


def person_spec(shape: Articulation, surface: RigSurface, vertices: Tensor, positions: Tensor) -> ShapeSpec:
    """Return the specification of a rig with other rest vertices and frames, its solids scaled with them."""
    tree = shape.kinematics.tree
    rest = shape.frame_transforms(torch.zeros_like(shape.rest)).detach().double()
    moved = rest.clone()
    moved[:, :3, 3] = positions.double()
    joints = [
        replace(joint, offset=invert_rigid(moved[joint.parent]) @ moved[index] if joint.parent >= 0 else moved[index])
        for index, joint in enumerate(tree.joints)
    ]
    grown = RigSurface(vertices.double(), surface.faces, surface.weights)
    index = shape.part_index
    return ShapeSpec(
        tree=KinematicTree(tuple(joints)),
        part_frames=tuple(tree.joints[frame].name for frame in index.tolist()),
        primitives=tuple(_grown_solids(shape.primitives.solids(), surface, grown, rest[index], moved[index])),
        nu=shape.start_nu,
        part_names=shape.part_names,
        surface=grown,
        sharpness=shape.start_sharpness,
        up=shape.up,
    )


def _grown_solids(
    solids: Sequence[Primitive], surface: RigSurface, grown: RigSurface, frames: Tensor, moved: Tensor
) -> list[Primitive]:
    """Return solids that grow along and across as the vertices of their parts do."""
    owners = surface.weights.argmax(-1)
    result = []
    for part, solid in enumerate(solids):
        owned = (owners == part).nonzero()[:, 0]
        if len(owned) < _TOLERANCES.min_owned:
            owned = surface.weights[:, part].topk(min(_TOLERANCES.min_owned, len(owners))).indices
        pose = solid.pose.double()
        before, after = (
            (points[owned].double() - frame[:3, 3]) @ frame[:3, :3] @ pose[:3, :3]
            for points, frame in ((surface.vertices, frames[part]), (grown.vertices, moved[part]))
        )
        ratio = after.std(0) / before.std(0).clamp_min(torch.finfo(before.dtype).tiny)
        ratio = torch.where(ratio.isfinite() & (ratio > 0), ratio, 1.0)
        across = (ratio[0] * ratio[1]).sqrt()
        factors = torch.stack([across, across, ratio[2]])
        center = after.mean(0) + (pose[:3, 3] @ pose[:3, :3] - before.mean(0)) * factors
        sizes = tuple(
            float(value * (ratio[2] if size.is_long else across)) if size.is_length else value
            for value, size in zip(solid.sizes, PRIMITIVE_KINDS[solid.kind].sizes, strict=True)
        )
        placed = pose.clone()
        placed[:3, 3] = pose[:3, :3] @ center
        result.append(Primitive(solid.kind, sizes, placed))
    return result


def save_rig(
    path: str | Path, source: str | Path, shape: Articulation, surface: RigSurface, skin: str | int | None
) -> Path:
    """Write the rig of a file with the vertices and bones of a shape; see `ArticulatedShape.to_gltf`."""
    tree = shape.kinematics.tree
    frames = shape.frame_transforms(torch.zeros_like(shape.rest)).detach().double()
    # A joint of the file is the first of the frames that its axes are stacked on.
    positions = {joint.name: frames[index, :3, 3] for index, joint in enumerate(tree.joints) if joint.kind == "fixed"}
    from torchreg.io.gltf_file.refit import save_refitted_rig

    return save_refitted_rig(path, source, surface.vertices, positions, skin=skin)
