"""Descriptors of scan samples whose plain distance tells whether they show one place, learned from made-up scans."""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.io.tensors import load_tensors
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.spin_images import spin_images

# Bins of the spin images, shares of the scan's size: a limb, and what is around it.
BIN_SIZES = (0.02, 0.05)
IMAGE_SIZE = 15
# Radii of the curvature features beside them.
CURVATURE_RADII = (0.02, 0.035, 0.06)
# Learned by `benchmarks/learn_descriptors.py`.
METRIC_FILE = Path(__file__).with_name("learned_descriptors.safetensors")


def surface_descriptors(few: OrientedSamples, scene: OrientedSamples) -> Tensor:
    """Return what is seen of a scan around each of a few samples, to learn from.

    Two spin images of square roots (few and many points differ less than that), each of unit length, and the samples'
    features.

    Args:
        few: Q samples to describe, of a scan whose size is one.
        scene: samples of all of the scan.

    Returns:
        (Q, 450 + D) float32, D features.

    Raises:
        InputTypeError: if dtypes or devices differ.

    Differentiable: no.

    Cost: two of `spin_images`.
    """
    surface = tuple(value.float() for value in (few.points, few.normals, scene.points, scene.normals))
    images = [spin_images(*surface, bin_size=size, image_size=IMAGE_SIZE).flatten(1).sqrt() for size in BIN_SIZES]
    unit = [torch.nn.functional.normalize(image, dim=-1) for image in images]
    return torch.cat((*unit, few.features.detach().float()), dim=1)


def learned_descriptors(few: OrientedSamples, scene: OrientedSamples) -> Tensor:
    """Return 32 numbers for each of a few samples; a smaller distance of two is better evidence of one place.

    `surface_descriptors` along `linear_discriminants`: what changes while something moves, or while a camera sees it
    from elsewhere, is left out. Match them with `match_descriptors` and ``similarity="distance"``.

    Args:
        few: Q samples to describe, of a scan whose size is one, with the six features of `curvature_features` at
            ``CURVATURE_RADII``, scaled by `scaled_together`.
        scene: samples of all of the scan, about 1,250 spread evenly.

    Returns:
        (Q, 32) float32, on the device of the samples.

    Raises:
        InputError: if there are not six features.
        InputTypeError: if dtypes or devices differ.

    Differentiable: no.

    Cost: as `surface_descriptors`.
    """
    full = surface_descriptors(few, scene)
    directions = learned_directions()
    if full.shape[1] != len(directions):
        features = len(directions) - len(BIN_SIZES) * IMAGE_SIZE**2
        raise InputError(f"few must have the {features} features that were learned from, got {few.features.shape[1]}")
    return full @ directions.to(full)


@functools.cache
def learned_directions() -> Tensor:
    """Return the directions (456, 32) that come with the package."""
    return load_tensors(METRIC_FILE)[0]["directions"].float()
