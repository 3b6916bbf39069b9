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

from torchreg._checks import as_float_tensor, check_count, check_finite, check_positive, check_shape
from torchreg.errors import InputError, InputTypeError, SolverError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Relative to the diagonal of the Hessian; each is tried after the one before left a system unsolvable.
_RIDGES = (0.0, 1e-12, 1e-10, 1e-8)
# A larger share of the slope held up by the ridge means that nothing but the ridge does.
_MAX_RIDGE_SHARE = 0.1
_DENSE_SIZE = 300
# Signs are mostly right long before the solution is.
_ROUGH = 1e-3
# Relative to the KKT tolerance, for the systems solved before it is tested.
_SOLVE_SHARE = 0.1
_ROUNDING = 1e-12
_MAX_CG_STEPS = 2000


@dataclass(frozen=True)
class NNLSResult:
    """A non-negative least-squares solution.

    Args:
        x: (n,), on the dtype and device of the right-hand side.
        objective: at ``x``; of `nnls` the squared residual and the regularizer, of `nnls_normal` ``x^T H x - 2 g^T x``.
        kkt_residual: largest violation of the optimality conditions (slope where x > 0, negative slope where x = 0),
            with every variable scaled to unit curvature, relative to the largest slope at x = 0.
        ridge: added to H as a share of its diagonal because H was singular; 0 if none was needed.
        num_steps: rounds of freeing variables.
        num_solves: linear systems solved.
        converged: whether ``kkt_residual`` came below the tolerance, the ridge left out.
    """

    x: Tensor
    objective: float
    kkt_residual: float
    ridge: float
    num_steps: int
    num_solves: int
    converged: bool


def nnls(
    matrix: Any,
    target: Any,
    *,
    regularizer: Any = None,
    start: Any = None,
    support: Any = None,
    max_steps: int = 50,
    tol: float = 1e-7,
) -> NNLSResult:
    """Return ``argmin_{x >= 0} |A x - b|^2 + x^T R x``.

    An active set is guessed by elimination: the least squares over the free variables are solved and all that came out
    negative are held at zero, until none is. Then variables at zero whose slope is negative are freed and it starts
    over, until there are none. A round that fails to lower the objective is repeated in steps that never leave x >= 0
    and always lower it, so that the iteration cannot cycle.

    Args:
        matrix: (m, n) A: a scipy sparse matrix or a tensor, sparse or dense.
        target: (m,) b.
        regularizer: (n, n) R, symmetric and positive semidefinite; none by default.
        start: (n,) near the solution; its positive entries are free first unless ``support`` is given.
        support: (n,) True for variables that are free first; all by default.
        max_steps: most rounds.
        tol: of the KKT residual.

    Returns:
        an `NNLSResult`; without convergence, the best found.

    Raises:
        InputError: if sizes differ or a number is not finite.
        SolverError: if the systems stay unsolvable within the ridges allowed, 1e-8 of the diagonal.

    Differentiable: no.

    Cost: systems of up to 300 free variables by Cholesky factors, larger ones by preconditioned conjugate gradients,
    or sparse LU factors where those are too slow.

    References: Schaefer and Yuksel 2007 for the elimination; Lawson and Hanson 1974 for the steps that cannot cycle.
    """
    a = _sparse(matrix, "matrix")
    b, like = _vector(target, "target", a.shape[0])
    size = a.shape[1]
    penalty = csr_matrix((size, size)) if regularizer is None else _square(regularizer, "regularizer", size)
    x, kkt, ridge, steps, solves = _minimize((a.T @ a + penalty).tocsr(), a.T @ b, start, support, max_steps, tol)
    # The residual keeps digits that A^T A loses.
    objective = float(((a @ x - b) ** 2).sum() + x @ (penalty @ x))
    return NNLSResult(_tensor(x, like), objective, kkt, ridge, steps, solves, kkt <= tol)


def nnls_normal(
    hessian: Any,
    linear: Any,
    *,
    start: Any = None,
    support: Any = None,
    max_steps: int = 50,
    tol: float = 1e-7,
) -> NNLSResult:
    """Return ``argmin_{x >= 0} x^T H x - 2 g^T x``, which is `nnls` for ``H = A^T A + R`` and ``g = A^T b``.

    Args:
        hessian: (n, n) H, symmetric and positive semidefinite: a scipy sparse matrix or a tensor, sparse or dense.
        linear: (n,) g.
        start: see `nnls`.
        support: see `nnls`.
        max_steps: see `nnls`.
        tol: see `nnls`.

    Returns:
        an `NNLSResult`; without convergence, the best found.

    Raises:
        InputError: if sizes differ, a number is not finite, or H is not symmetric or has a negative diagonal.
        SolverError: if the systems stay unsolvable within the ridges allowed, as when there is no least value.

    Differentiable: no.
    """
    g, like = _vector(linear, "linear", None)
    h = _square(hessian, "hessian", len(g))
    x, kkt, ridge, steps, solves = _minimize(h, g, start, support, max_steps, tol)
    return NNLSResult(_tensor(x, like), float(x @ (h @ x) - 2 * (g @ x)), kkt, ridge, steps, solves, kkt <= tol)


def _minimize(
    hessian: csr_matrix, linear: Floats, start: Any, support: Any, max_steps: int, tol: float
) -> tuple[Floats, float, float, int, int]:
    """Return solution, KKT residual, ridge, rounds and systems solved."""
    check_count(max_steps, "max_steps", 1)
    check_positive(tol, "tol")
    diagonal = hessian.diagonal()
    if (diagonal < 0).any():
        raise InputError(f"hessian must be positive semidefinite, got {diagonal.min()} on its diagonal")
    # A variable that nothing depends on stays zero.
    active = diagonal > 0
    if (linear[~active] > 0).any():
        raise SolverError("hessian has no curvature along a variable whose slope is negative; there is no least value")
    scale = np.where(active, 1 / np.sqrt(np.where(active, diagonal, 1.0)), 0.0)
    scaled = (diags(scale) @ hessian @ diags(scale)).tocsr()
    first = active if support is None else active & _flags(support, len(linear))
    y = np.zeros_like(linear)
    if start is not None:
        y[active] = np.maximum(_vector(start, "start", len(linear))[0], 0.0)[active] / scale[active]
        first = (y > 0) if support is None else first
    exact = _Quadratic(scaled, scale * linear, tol)
    solves = 0
    for ridge in _RIDGES:
        repaired = _Quadratic((scaled + ridge * diags(active.astype(np.float64))).tocsr(), scale * linear, tol)
        try:
            y, steps = _active_set(repaired, first, y, active, max_steps)
        except _Singular:
            solves += repaired.num_solves
            continue
        if exact.violation(y) > _MAX_RIDGE_SHARE + repaired.violation(y):
            break
        return scale * y, exact.violation(y), ridge, steps, solves + repaired.num_solves
    raise SolverError(
        f"hessian is singular beyond a ridge of {_RIDGES[-1]} of its diagonal, not positive semidefinite, or leaves "
        f"the objective without a least value; add a regularizer"
    )


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
        """Return half the gradient, relative to the largest at zero."""
        slope: Floats = (self.hessian @ y - self.linear) / self.size
        return slope

    def violation(self, y: Floats) -> float:
        """Return the KKT residual."""
        slope = self.slope(y)
        return float(np.where(y > 0, np.abs(slope), np.maximum(-slope, 0.0)).max(initial=0.0))

    def solve(self, free: Flags, start: Floats, share: float) -> Floats:
        """Return the minimum over the free variables, the others zero, to ``share`` of the largest slope at zero.

        Raises:
            _Singular: if none is found.
        """
        self.num_solves += 1
        index = np.flatnonzero(free)
        solution = np.zeros_like(self.linear)
        if not len(index):
            return solution
        block, right = self.hessian[index][:, index], self.linear[index]
        if len(index) <= _DENSE_SIZE:
            solution[index] = _cholesky(block, right)
        else:
            found = _conjugate_gradients(block, right, start[index], share * self.size)
            if found is not None:
                solution[index] = found
                return solution
            solution[index] = _lu(block, right)
        # Factors of a nearly singular matrix exist but may solve nothing.
        if not np.abs(block @ solution[index] - right).max() <= _SOLVE_SHARE * self.tol * self.size:
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
    """Return x with ``|A x - b| <= atol`` in every entry, or None if steps run out; A has about unit diagonal.

    Raises:
        _Singular: if a direction has no curvature.
    """
    x = start.copy()
    residual = right - matrix @ x
    direction, square = residual.copy(), residual @ residual
    for _ in range(_MAX_CG_STEPS):
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
        level = trial_value <= value + _ROUNDING * abs(value) and trial_violation < violation
        if not (trial_value < value or level):
            trial = _descend(problem, y, entering)
            trial_value, trial_violation = problem.value(trial), problem.violation(trial)
        y, value, violation = trial, trial_value, trial_violation
    return y, max_steps


def _eliminate(problem: _Quadratic, free: Flags, start: Floats) -> Floats:
    """Return the minimum over what is left of the free variables after all that came out negative were dropped."""
    fine = _SOLVE_SHARE * problem.tol
    share, y = _ROUGH, np.where(free, start, 0.0)
    while True:
        y = problem.solve(free, y, share)
        negative = y < 0
        if negative.any():
            free = free & ~negative
            y[negative] = 0.0
        elif share <= fine or np.count_nonzero(free) <= _DENSE_SIZE:
            return y
        else:
            share = fine


def _descend(problem: _Quadratic, y: Floats, entering: Flags) -> Floats:
    """Return a point of lower value: the minimum over the positive and entering variables, approached within y >= 0.

    ``y`` is the minimum over its positive variables, so that some entering one comes out positive however many others
    are dropped.
    """
    fine = _SOLVE_SHARE * problem.tol
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


def _sparse(value: Any, name: str) -> csr_matrix:
    """Return ``value`` as a checked float64 CSR matrix."""
    if issparse(value):
        result = csr_matrix(value, dtype=np.float64)
    else:
        if not isinstance(value, (Tensor, np.ndarray)):
            raise InputTypeError(f"{name} must be a scipy sparse matrix or a tensor, got {type(value).__name__}")
        tensor = as_float_tensor(value, name)
        check_shape(tensor, name, ("rows", "columns"))
        entries = tensor.detach().cpu().to_sparse_coo().coalesce()
        rows, columns = entries.indices().numpy()
        data = entries.values().double().numpy()
        result = coo_matrix((data, (rows, columns)), shape=tuple(tensor.shape)).tocsr()
    bad = int((~np.isfinite(result.data)).sum())
    if bad:
        raise InputError(f"{name} must be finite, got {bad} non-finite numbers")
    return result


def _square(value: Any, name: str, size: int) -> csr_matrix:
    """Return ``value`` as a checked symmetric CSR matrix."""
    result = _sparse(value, name)
    if result.shape != (size, size):
        raise InputError(f"{name} must have shape ({size}, {size}), got {result.shape}")
    skew = abs(result - result.T).max() if size else 0.0
    if skew > 1e-6 * abs(result).max():
        raise InputError(f"{name} must be symmetric, got entries that differ by {skew} from their mirror images")
    return result


def _vector(value: Any, name: str, size: int | None) -> tuple[Floats, Tensor]:
    """Return ``value`` as checked float64 (size,), and the tensor whose kind results take."""
    tensor = as_float_tensor(value, name)
    check_shape(tensor, name, ("n" if size is None else size,))
    check_finite(tensor, name)
    array: Floats = tensor.detach().cpu().double().numpy()
    return array, tensor


def _flags(value: Any, size: int) -> Flags:
    """Return a support as checked flags (size,)."""
    flags = torch.as_tensor(value)
    if flags.dtype != torch.bool:
        raise InputTypeError(f"support must hold True or False, got dtype {flags.dtype}")
    check_shape(flags, "support", (size,))
    array: Flags = flags.cpu().numpy()
    return array


def _tensor(x: Floats, like: Tensor) -> Tensor:
    return torch.from_numpy(x).to(dtype=like.dtype, device=like.device)
