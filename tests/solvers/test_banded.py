"""Block-banded systems against dense algebra."""

import pytest
import torch

from torchreg.solvers.banded import BandedSystem


@pytest.mark.parametrize(("count", "width"), [(1, 2), (2, 2), (7, 2), (6, 1), (5, 0)])
def test_solution_and_blocks_of_the_inverse_are_those_of_the_dense_matrix(count, width):
    size, generator = 3, torch.Generator().manual_seed(0)
    dense = torch.zeros(count * size, count * size, dtype=torch.float64)
    lower = [torch.randn(count, size, size, generator=generator, dtype=torch.float64) for _ in range(width + 1)]
    lower[0] = lower[0] @ lower[0].mT + 20 * torch.eye(size)
    for apart, blocks in enumerate(lower):
        for row in range(apart, count):
            place = slice(row * size, (row + 1) * size), slice((row - apart) * size, (row - apart + 1) * size)
            dense[place] = blocks[row]
            dense[place[1], place[0]] = blocks[row].mT
    right = torch.randn(count, size, generator=generator, dtype=torch.float64)
    system = BandedSystem(lower)
    torch.testing.assert_close(system.solve(right).flatten(), torch.linalg.solve(dense, right.flatten()))
    inverse = torch.linalg.inv(dense)
    for apart, blocks in enumerate(system.inverse()):
        for row in range(apart, count):
            wanted = inverse[row * size : (row + 1) * size, (row - apart) * size : (row - apart + 1) * size]
            torch.testing.assert_close(blocks[row], wanted)
