"""The bodies and hands of anny as rigs with phenotypes as coefficients."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_choice
from torchreg.errors import FormatError, MissingExtraError
from torchreg.geometry.upright import Z_UP
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.rigs import spec_from_arrays
from torchreg.shapes.shape_space import CoefficientPrior, Features, LinearSpace
from torchreg.shapes.shaped_rig import frame_joints
from torchreg.shapes.spec import ShapeSpec

KINDS = ("body", "hand.R", "hand.L")
# Of what is kept: another number when its contents change.
_RELEASE = 1
# Standard deviation of a number that is anywhere from 0 to 1.
_UNIFORM_STD = 12**-0.5


class Phenotypes(Features):
    """The blend weights of anny's phenotypes: products of hat functions, one per phenotype, in a compact basis.

    ``anchors`` are the values at which a hat is one, ``fixed`` (C,) hats of what is no coefficient, ``mask``
    (W, sum A_k + C) the hats that each weight is the product of, ``projection`` (W, L) onto the basis.
    """

    fixed: Tensor
    mask: Tensor
    projection: Tensor

    def __init__(self, anchors: Sequence[Tensor], fixed: Tensor, mask: Tensor, projection: Tensor) -> None:
        super().__init__()
        self.count = len(anchors)
        for number, values in enumerate(anchors):
            self.register_buffer(f"anchors_{number}", values, persistent=False)
        for name, value in {"fixed": fixed, "mask": mask, "projection": projection}.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, coefficients: Tensor) -> Tensor:
        """Return the features (..., L) of coefficients (..., K); at an anchor the slope is the mean of both sides."""
        hats = [_hats(coefficients[..., k], self.get_buffer(f"anchors_{k}")) for k in range(self.count)]
        values = torch.cat([*hats, self.fixed.expand(*coefficients.shape[:-1], -1)], dim=-1).unsqueeze(-2)
        return (values * self.mask + (1 - self.mask)).prod(-1) @ self.projection

    def jacobian(self, coefficients: Tensor) -> Tensor:
        """Return the derivatives (..., L, K) of the features with respect to coefficients (..., K)."""
        anchors = [self.get_buffer(f"anchors_{k}") for k in range(self.count)]
        masks = self.mask.split([*(len(values) for values in anchors), len(self.fixed)], dim=-1)
        constant = (self.fixed * masks[-1] + (1 - masks[-1])).prod(-1)
        factors, slopes = [], []
        for k, (values, mask) in enumerate(zip(anchors, masks, strict=False)):
            hats = _hats(coefficients[..., k], values).unsqueeze(-2)
            factors.append((hats * mask + (1 - mask)).prod(-1))
            slopes.append(_hat_slopes(coefficients[..., k], values) @ mask.mT)
        one = torch.eye(self.count, dtype=torch.bool, device=coefficients.device).unsqueeze(-1)
        rows = torch.where(one, torch.stack(slopes, dim=-2).unsqueeze(-3), torch.stack(factors, dim=-2).unsqueeze(-3))
        return ((rows.prod(-2) * constant) @ self.projection).mT


def _hats(value: Tensor, anchors: Tensor) -> Tensor:
    """Return the hat functions (..., A) at values (...)."""
    share = (value.unsqueeze(-1) - anchors[:-1]) / anchors.diff()
    # Minimum and maximum share their slope where both are equal, unlike clamp.
    passed = torch.minimum(torch.maximum(share, torch.zeros_like(share)), torch.ones_like(share))
    one = torch.ones_like(passed[..., :1])
    return torch.cat([one, passed], dim=-1) - torch.cat([passed, torch.zeros_like(one)], dim=-1)


def _hat_slopes(value: Tensor, anchors: Tensor) -> Tensor:
    """Return the slopes of `_hats` (..., A) at values (...), at an anchor the mean of both sides."""
    share = (value.unsqueeze(-1) - anchors[:-1]) / anchors.diff()
    inside = torch.heaviside(share, share.new_tensor(0.5)) * torch.heaviside(1 - share, share.new_tensor(0.5))
    slope = inside / anchors.diff()
    none = torch.zeros_like(slope[..., :1])
    return torch.cat([none, slope], dim=-1) - torch.cat([slope, none], dim=-1)


def load_anny(kind: str) -> tuple[ShapeSpec, LinearSpace]:
    """Return the rig of a kind of `KINDS` at its mean coefficients, and the space of its rest states."""
    check_choice(kind, "kind", KINDS)
    try:
        version = metadata.version("anny")
    except metadata.PackageNotFoundError:
        hint = "install it with: pip install 'torchreg-articulated[anny]'"
        raise MissingExtraError(f"anny is not installed; {hint}") from None
    folder = Path(os.environ.get("ANNY_CACHE_DIR") or Path.home() / ".cache" / "anny")
    kept = folder / f"torchreg-{_RELEASE}-{version}-{kind}.safetensors"
    try:
        arrays, names = load_tensors(kept)
        return _rig(arrays, names)
    except (FileNotFoundError, FormatError, KeyError):
        pass  # not kept yet, or damaged: it is built anew
    arrays, names = _built(kind)
    spec = _rig(arrays, names)[0]
    arrays["solid_sizes"] = torch.tensor([solid.sizes for solid in spec.primitives], dtype=torch.float64)
    arrays["solid_poses"] = torch.stack([solid.pose for solid in spec.primitives])
    folder.mkdir(parents=True, exist_ok=True)
    save_tensors(kept, arrays, names)
    return _rig(arrays, names)


def _built(kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the arrays of anny's model, and its names."""
    import anny

    model = anny.Anny() if kind == "body" else anny.Anny(rig=f"anny-{kind}", topology=kind)
    labels = list(model.phenotype_labels)
    # Columns of the mask: three races, which count alike, then the coefficients, then cup size and firmness at 1/2.
    widths = [len(model.anchors[label]) for label in labels]
    total = model.stacked_phenotype_blend_shapes_mask.shape[1]
    order = [*range(3, 3 + sum(widths)), 0, 1, 2, *range(3 + sum(widths), total)]
    weights = torch.zeros(len(model.template_vertices), len(model.bone_labels), dtype=torch.float64)
    weights.scatter_add_(1, model.vertex_bone_indices.long(), model.vertex_bone_weights.double())
    arrays = {
        "vertices": model.template_vertices, "vertex_dirs": model.blendshapes.permute(1, 2, 0).float(),
        "joints": model.template_bone_heads, "joint_dirs": model.bone_heads_blendshapes.permute(1, 2, 0).float(),
        "faces": model.get_triangular_faces().long(), "weights": weights,
        "parents": torch.tensor([int(parent) for parent in model.bone_parents]),
        "mask": model.stacked_phenotype_blend_shapes_mask[:, order].float(),
        "projection": model.phenotype_blendshape_projection,
        "fixed": torch.tensor([1 / 3] * 3 + [0.0, 1.0, 0.0] * 2, dtype=torch.float64),
    }  # fmt: skip
    arrays.update({f"anchors_{number}": model.anchors[label] for number, label in enumerate(labels)})
    found = {name: value.detach().clone().contiguous() for name, value in arrays.items()}
    return found, {"phenotypes": labels, "joints": list(model.bone_labels)}


def _rig(arrays: Mapping[str, Tensor], names: Mapping[str, Any]) -> tuple[ShapeSpec, LinearSpace]:
    """Return the rig at its mean, with the solids that are kept or fitted ones, and its space."""
    labels, joints = list(names["phenotypes"]), list(names["joints"])
    anchors = [arrays[f"anchors_{number}"].double() for number in range(len(labels))]
    features = Phenotypes(anchors, *(arrays[name].double() for name in ("fixed", "mask", "projection")))
    half = torch.full((len(labels),), 0.5, dtype=torch.float64)
    mean = features(half)
    at_mean, heads = (
        arrays[name] + arrays[directions].double() @ mean
        for name, directions in (("vertices", "vertex_dirs"), ("joints", "joint_dirs"))
    )
    solids = None
    if "solid_sizes" in arrays:
        pairs = zip(arrays["solid_sizes"].tolist(), arrays["solid_poses"], strict=True)
        solids = [Primitive("ellipsoid", tuple(sizes), pose) for sizes, pose in pairs]
    spec = spec_from_arrays(
        at_mean, arrays["faces"], arrays["weights"], heads, arrays["parents"].tolist(), joint_names=joints,
        solids=solids, up=Z_UP,
    )  # fmt: skip
    prior = CoefficientPrior(
        names=tuple(labels), mean=half, std=torch.full_like(half, _UNIFORM_STD), lower=torch.zeros_like(half),
        upper=torch.ones_like(half),
    )  # fmt: skip
    owners = frame_joints(spec.tree, joints)
    space = LinearSpace(
        arrays["vertices"], arrays["vertex_dirs"], arrays["joints"][owners], arrays["joint_dirs"][owners], prior,
        features,
    )  # fmt: skip
    return spec, space
