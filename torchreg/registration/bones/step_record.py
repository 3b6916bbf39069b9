"""The record of a step of a scan registration: residuals, joints, labels, and the energy of the paper by terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from torchreg.registration.bones.closest_compatible import CompatibleMatches
from torchreg.registration.bones.config import BoneConfig
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.registration_energy import EnergyState, energy_terms, term_weights
from torchreg.registration.results import RegisterRecord


def reported_weights(config: BoneConfig) -> dict[str, float]:
    """Return the weights of the terms of eq. 2 in records: the same in all steps, so that energies compare."""
    refine = config.refine
    return term_weights(smoothness=refine.smoothness, norm=refine.normalization, discontinuity=refine.closeness)


def cut_edges(labels: Tensor, data: CellData) -> int:
    """Return the number of pairs of neighboring cells with different labels (C,)."""
    first, second = data.neighbors.unbind(-1)
    return int((labels[first] != labels[second]).sum())


def step_record(
    state: EnergyState,
    weights: Mapping[str, float],
    *,
    cut_edges: int,
    joint: float,
    matches: Sequence[CompatibleMatches],
    at: tuple[str, int, int],
) -> RegisterRecord:
    """Return the record of a step."""
    pairs = state.correspondences
    residuals = pairs.weights * pairs.squared_residuals(state.moved)
    stage, step, num_steps = at
    return RegisterRecord(
        stage=stage,
        step=step,
        num_steps=num_steps,
        distance=float(residuals.sum() / pairs.weights.sum().clamp_min(1e-300)),
        joint=joint,
        smoothness=cut_edges,
        num_labels=state.model.num_bones,
        energies={name: float(term.mean()) for name, term in energy_terms(state, weights).items()},
        **{
            name: sum(int(getattr(frame, name).sum()) for frame in matches)
            for name in ("kept", "boundary", "far", "turned")
        },
    )
