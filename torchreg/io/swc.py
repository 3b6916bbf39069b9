"""SWC, the text format for branching tubes: one node per line, with its radius and its parent."""

from __future__ import annotations

import os
from enum import IntEnum

import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_allowed, local_path, read_bytes


class _NodeType(IntEnum):
    """Types of nodes in the format."""

    UNDEFINED = 0
    BRANCHING = 5
    END = 6


def save_swc(path: str | os.PathLike[str], skeleton: Skeleton, comment: str = "") -> None:
    """Write a skeleton: its first tip is the root; branchings have the type 5, ends 6, other nodes 0."""
    file = local_path(path)
    if file.suffix.lower() != ".swc":
        raise InputError(f"path must end in .swc, got {file.name!r}; rename the output file")
    order, parents = _walk(skeleton)
    number = {node: row + 1 for row, node in enumerate(order)}
    degrees = skeleton.degrees.tolist()
    nodes, radii = skeleton.nodes.detach().cpu().tolist(), skeleton.radii.detach().cpu().tolist()
    lines = [f"# {line}" for line in (*comment.splitlines(), "number type x y z radius parent")]
    for node in order:
        end, branching = degrees[node] <= 1, degrees[node] > 2
        kind = _NodeType.END if end else _NodeType.BRANCHING if branching else _NodeType.UNDEFINED
        values = " ".join(f"{value:.9g}" for value in (*nodes[node], radii[node]))
        lines.append(f"{number[node]} {kind:d} {values} {number.get(parents[node], -1)}")
    write_atomic(file, ("\n".join(lines) + "\n").encode())


def load_swc(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Skeleton:
    """Return the skeleton of a file, float64; FormatError if its nodes make no single tree."""
    file = local_path(path)
    rows = []
    for number, line in enumerate(read_bytes(file, limits).decode("utf-8", "replace").splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            if len(words) != 7:
                raise ValueError(f"{len(words)} columns instead of 7")
            rows.append((int(words[0]), *(float(word) for word in words[2:6]), int(words[6])))
        except ValueError as error:
            raise FormatError(f"{file}: line {number} is no node ({error})") from error
    check_allowed(len(rows), "nodes", limits)
    index = {row[0]: number for number, row in enumerate(rows)}
    try:
        edges = [(index[row[5]], index[row[0]]) for row in rows if row[5] >= 0]
        values = torch.tensor([row[1:5] for row in rows], dtype=torch.float64).reshape(-1, 4)
        return Skeleton(values[:, :3], torch.tensor(edges).reshape(-1, 2).long(), values[:, 3])
    except (KeyError, InputError) as error:
        raise FormatError(f"{file}: the nodes make no tree ({error})") from error


def _walk(skeleton: Skeleton) -> tuple[list[int], dict[int, int]]:
    """Return the nodes from the first tip outwards along the limbs, and the parent of each."""
    neighbors: list[list[int]] = [[] for _ in range(len(skeleton))]
    for start, end in skeleton.edges.tolist():
        neighbors[start].append(end)
        neighbors[end].append(start)
    root = int(skeleton.tips[0])
    order, parents, waiting = [], {root: -1}, [root]
    while waiting:
        node = waiting.pop()
        order.append(node)
        for neighbor in neighbors[node]:
            if neighbor not in parents:
                parents[neighbor] = node
                waiting.append(neighbor)
    return order, parents
