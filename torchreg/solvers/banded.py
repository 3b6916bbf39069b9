"""Positive definite systems whose blocks couple neighbors in a sequence: block-banded Cholesky."""

from __future__ import annotations

import torch
from torch import Tensor


class BandedSystem:
    """A symmetric matrix of T x T blocks (D, D), of which ``lower[k]`` (T, D, D) couple each t with t - k.

    Factorized as ``L L^T`` with blocks as far from the diagonal. Cost: O(T W^2 D^3) for W blocks beside the diagonal.
    """

    def __init__(self, lower: list[Tensor]) -> None:
        self.width, self.count = len(lower) - 1, len(lower[0])
        self.factor = [block.clone() for block in lower]
        for row in range(self.count):
            for apart in range(min(self.width, row), -1, -1):
                column, block = row - apart, self.factor[apart][row]
                for other in range(apart + 1, min(self.width, row) + 1):
                    if other - apart <= self.width:
                        block -= self.factor[other][row] @ self.factor[other - apart][column].mT
                if apart:
                    solved = torch.linalg.solve_triangular(self.factor[0][column], block.mT, upper=False).mT
                else:
                    solved = torch.linalg.cholesky(block)
                self.factor[apart][row] = solved

    def solve(self, right: Tensor) -> Tensor:
        """Return the solution (T, D) for a right side (T, D)."""
        found = right.clone()
        for row in range(self.count):
            for apart in range(1, min(self.width, row) + 1):
                found[row] -= self.factor[apart][row] @ found[row - apart]
            found[row] = torch.linalg.solve_triangular(self.factor[0][row], found[row, :, None], upper=False)[:, 0]
        for row in reversed(range(self.count)):
            for apart in range(1, min(self.width, self.count - 1 - row) + 1):
                found[row] -= self.factor[apart][row + apart].mT @ found[row + apart]
            found[row] = torch.linalg.solve_triangular(self.factor[0][row].mT, found[row, :, None], upper=True)[:, 0]
        return found

    def inverse(self) -> list[Tensor]:
        """Return the blocks of the inverse that have any in the matrix, as ``lower``: Takahashi et al. 1973."""
        found = [torch.zeros_like(block) for block in self.factor]

        def block(row: int, column: int) -> Tensor:
            return found[row - column][row] if row >= column else found[column - row][column].mT

        identity = torch.eye(found[0].shape[-1]).to(found[0])
        for column in reversed(range(self.count)):
            below = range(1, min(self.width, self.count - 1 - column) + 1)
            root = torch.linalg.solve_triangular(self.factor[0][column], identity, upper=False)
            steps = {apart: self.factor[apart][column + apart] @ root for apart in below}
            for apart in reversed(below):
                row = column + apart
                found[apart][row] = -sum(block(row, column + other) @ steps[other] for other in below)
            found[0][column] = root.mT @ root - sum(block(column, column + other) @ steps[other] for other in below)
        return found
