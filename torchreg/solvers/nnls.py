"""Sparse least squares under x >= 0, by elimination of an active set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import coo_matrix, csr_matrix, diags, issparse
from scipy.sparse.linalg import splu
from torch import Tensor

from torchreg.errors import SolverError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class _EliminationSettings:
    """Numbers of the elimination and of its linear systems."""

    # Ridges, relative to the diagonal of the Hessian, each tried after a system was unsolvable with the one before.
    ridges: tuple[float, ...] = (0.0, 1e-12, 1e-10, 1e-8)
    # Share of the slope that the ridge may balance; more means that only the ridge holds the solution.
    max_ridge_share: float = 0.1
    # Free variables up to which systems are solved by Cholesky factors.
    dense_size: int = 300
    # Residual of systems solved for their signs alone, which are mostly right long before the solution is.
    rough: float = 1e-3
    # Residual of all other systems, relative to the KKT tolerance.
    fine: float = 0.1
    # Relative difference of objectives that may be rounding.
    rounding: float = 1e-12
    # Steps of conjugate gradients after which a system is factored instead.
    max_cg_steps: int = 2000


_SETTINGS = _EliminationSettings()


@dataclass(frozen=True)
class NNLSResult:
    """A non-negative least-squares solution."""

    x: Tensor
    objective: float  # squared residual at ``x``
    # largest violation of the optimality conditions (slope where x > 0, negative slope where x = 0), with every
    # variable scaled to unit curvature, relative to the largest slope at x = 0
    kkt_residual: float
    ridge: float  # added to the Hessian as a share of its diagonal because that was singular; 0 if none was needed
    num_steps: int  # rounds of freeing variables
    num_solves: int
    converged: bool  # whether ``kkt_residual`` came below the tolerance, without the ridge


def nnls(
    matrix: Any, target: Tensor, *, start: Tensor | None = None, max_steps: int = 50, tol: float = 1e-7
) -> NNLSResult:
    """Return ``argmin_{x >= 0} |A x - b|^2``, or the best found; A (m, n) is a torch or scipy matrix, sparse or dense.

    The free variables are solved and the negative ones held at zero, until none is; then variables at zero with a
    negative slope are freed. A round that does not lower the objective is repeated in steps that always do, so it
    cannot cycle (Schaefer and Yuksel 2007 for the elimination; Lawson and Hanson 1974 for the steps that cannot cycle).
    """
    a, b = _csr(matrix), target.detach().cpu().double().numpy()
    hessian, linear = (a.T @ a).tocsr(), a.T @ b
    diagonal = hessian.diagonal()
    # A variable that nothing depends on stays zero.
    active = diagonal > 0
    scale = np.where(active, 1 / np.sqrt(np.where(active, diagonal, 1.0)), 0.0)
    scaled = (diags(scale) @ hessian @ diags(scale)).tocsr()
    y, free = np.zeros_like(linear), active
    if start is not None:
        first = np.maximum(start.detach().cpu().double().numpy(), 0.0)
        y[active] = first[active] / scale[active]
        free = y > 0
    exact, num_solves = _Quadratic(scaled, scale * linear, tol), 0
    for ridge in _SETTINGS.ridges:
        repaired = _Quadratic((scaled + ridge * diags(active.astype(np.float64))).tocsr(), scale * linear, tol)
        try:
            y, num_steps = _active_set(repaired, free, y, active, max_steps)
        except _Singular:
            num_solves += repaired.num_solves
            continue
        violation = exact.violation(y)
        if violation > _SETTINGS.max_ridge_share + repaired.violation(y):
            break
        x = scale * y
        return NNLSResult(
            x=torch.from_numpy(x).to(target),
            # The residual keeps digits that A^T A loses.
            objective=float(((a @ x - b) ** 2).sum()),
            kkt_residual=violation,
            ridge=ridge,
            num_steps=num_steps,
            num_solves=num_solves + repaired.num_solves,
            converged=violation <= tol,
        )
    raise SolverError(
        f"the columns of the matrix are dependent beyond a ridge of {_SETTINGS.ridges[-1]} of the Hessian's diagonal; "
        f"add a regularizer"
    )


def _csr(matrix: Any) -> csr_matrix:
    """Return a scipy or torch matrix, sparse or dense, as float64 CSR."""
    if issparse(matrix):
        return csr_matrix(matrix, dtype=np.float64)
    entries = matrix.detach().cpu().to_sparse_coo().coalesce()
    rows, columns = entries.indices().numpy()
    return coo_matrix((entries.values().double().numpy(), (rows, columns)), shape=tuple(matrix.shape)).tocsr()


class _Singular(Exception):
    """A system has no sound solution."""


class _Quadratic:
    """``y^T H y - 2 g^T y`` with unit diagonal, and its systems."""

    def __init__(self, hessian: csr_matrix, linear: Floats, tol: float) -> None:
        self.hessian, self.linear, self.tol = hessian, linear, tol
        # Zero is the solution when no slope at zero is negative; a scale is then needed only to divide by.
        self.size = float(np.abs(linear).max(initial=0.0)) or 1.0
        self.num_solves = 0

    def value(self, y: Floats) -> float:
        return float(y @ (self.hessian @ y) - 2 * (self.linear @ y))

    def slope(self, y: Floats) -> Floats:
        """Return half the gradient (n,), relative to the largest at zero."""
        slope: Floats = (self.hessian @ y - self.linear) / self.size
        return slope

    def violation(self, y: Floats) -> float:
        """Return the KKT residual."""
        slope = self.slope(y)
        return float(np.where(y > 0, np.abs(slope), np.maximum(-slope, 0.0)).max(initial=0.0))

    def solve(self, free: Flags, start: Floats, share: float) -> Floats:
        """Return the minimum over the free variables, all others zero, to ``share`` of the largest slope at zero."""
        self.num_solves += 1
        index = np.flatnonzero(free)
        solution = np.zeros_like(self.linear)
        if not len(index):
            return solution
        block, right = self.hessian[index][:, index], self.linear[index]
        if len(index) <= _SETTINGS.dense_size:
            solution[index] = _cholesky(block, right)
        else:
            found = _conjugate_gradients(block, right, start[index], share * self.size)
            if found is not None:
                solution[index] = found
                return solution
            solution[index] = _lu(block, right)
        # Factors of a nearly singular matrix exist but may solve nothing.
        if not np.abs(block @ solution[index] - right).max() <= _SETTINGS.fine * self.tol * self.size:
            raise _Singular
        return solution


def _cholesky(matrix: csr_matrix, right: Floats) -> Floats:
    try:
        x: Floats = cho_solve(cho_factor(matrix.toarray()), right)
    except LinAlgError as error:
        raise _Singular from error
    return x


def _lu(matrix: csr_matrix, right: Floats) -> Floats:
    try:
        factors = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise _Singular from error
    x: Floats = factors.solve(right)
    return x


def _conjugate_gradients(matrix: csr_matrix, right: Floats, start: Floats, atol: float) -> Floats | None:
    """Return x with ``|A x - b| <= atol`` in every entry, or None if steps run out; A has about unit diagonal."""
    x = start.copy()
    residual = right - matrix @ x
    direction, square = residual.copy(), residual @ residual
    for _ in range(_SETTINGS.max_cg_steps):
        if np.abs(residual).max() <= atol:
            return x
        image = matrix @ direction
        curvature = direction @ image
        if curvature <= 0:
            raise _Singular
        x += (square / curvature) * direction
        residual -= (square / curvature) * image
        square, previous = residual @ residual, square
        direction = residual + (square / previous) * direction
    return None


def _active_set(problem: _Quadratic, free: Flags, y: Floats, active: Flags, max_steps: int) -> tuple[Floats, int]:
    """Return the minimum over y >= 0 and the rounds taken."""
    y = _eliminate(problem, free, y)
    value, violation = problem.value(y), problem.violation(y)
    for step in range(max_steps):
        entering = active & (y <= 0) & (problem.slope(y) < -problem.tol)
        if violation <= problem.tol or not entering.any():
            return y, step
        trial = _eliminate(problem, (y > 0) | entering, y)
        trial_value, trial_violation = problem.value(trial), problem.violation(trial)
        # Near the solution the values differ by less than their rounding while the slopes still improve.
        level = trial_value <= value + _SETTINGS.rounding * abs(value) and trial_violation < violation
        if not (trial_value < value or level):
            trial = _descend(problem, y, entering)
            trial_value, trial_violation = problem.value(trial), problem.violation(trial)
        y, value, violation = trial, trial_value, trial_violation
    return y, max_steps


def _eliminate(problem: _Quadratic, free: Flags, start: Floats) -> Floats:
    """Return the minimum over the free variables that remain after all that came out negative were dropped."""
    fine = _SETTINGS.fine * problem.tol
    share, y = _SETTINGS.rough, np.where(free, start, 0.0)
    while True:
        y = problem.solve(free, y, share)
        negative = y < 0
        if negative.any():
            free = free & ~negative
            y[negative] = 0.0
        elif share <= fine or np.count_nonzero(free) <= _SETTINGS.dense_size:
            return y
        else:
            share = fine


def _descend(problem: _Quadratic, y: Floats, entering: Flags) -> Floats:
    """Return a point of lower value: the minimum over the positive and entering variables, approached within y >= 0."""
    fine = _SETTINGS.fine * problem.tol
    y, positive = y.copy(), y > 0
    while True:
        goal = problem.solve(positive | entering, y, fine)
        dropped = entering & (goal <= 0)
        if dropped.any():
            entering = entering & ~dropped
            continue
        blocking = positive & (goal < 0)
        if not blocking.any():
            return goal
        # The first variable to reach zero ends the step and stays there.
        reach = np.full_like(y, np.inf)
        reach[blocking] = y[blocking] / (y[blocking] - goal[blocking])
        y = np.maximum(y + reach.min() * (goal - y), 0.0)
        y[reach.argmin()] = 0.0
        positive, entering = y > 0, np.zeros_like(entering)
