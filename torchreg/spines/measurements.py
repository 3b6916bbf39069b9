"""The table of a spine: lengths, radii and angles of its limbs over time."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from torchreg.io.pose_table import save_pose_table
from torchreg.spines.curves import curve_lengths

# Of a limb, from a junction: its direction there, which the nodes at the junction itself do not give.
_ROOT_SHARE = 1 / 3


@dataclass(frozen=True, eq=False)
class SpineMeasurements:
    """What is measured of the L limbs of a spine in T frames, lengths in the unit of the surfaces.

    Args:
        times: (T,).
        lengths: (T, L) along the limbs.
        radii: (T, L) mean distances of a limb to the surface.
        pairs: (A, 2) limbs that meet in a junction.
        angles: (T, A) between them, radians: of the directions from the junction to a third of each limb; NaN where a
            limb has no length.

    Of what grows, numbers are NaN where a limb is not there.
    """

    times: Tensor
    lengths: Tensor
    radii: Tensor
    pairs: Tensor
    angles: Tensor

    def table(self) -> tuple[list[str], list[list[float]]]:
        """Return the names of columns and a row per frame: time, then lengths, radii and angles, in degrees."""
        limbs = range(self.lengths.shape[1])
        names = ["time", *(f"length_{limb}" for limb in limbs), *(f"radius_{limb}" for limb in limbs)]
        names += [f"angle_{first}_{second}_deg" for first, second in self.pairs.tolist()]
        columns = (self.times[:, None], self.lengths, self.radii, self.angles * (180 / math.pi))
        return names, torch.cat([column.double() for column in columns], dim=1).tolist()

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the table as text, with commas between the columns; an existing file is replaced.

        Raises:
            FormatError: if the ending is not .csv.
            FileNotFoundError: if the folder does not exist.
        """
        save_pose_table(path, *self.table())


def measure_limbs(curves: Tensor, radii: Tensor, graph: Tensor, times: Tensor) -> SpineMeasurements:
    """Return the measurements of curves (T, L, S, 3) with radii of a graph (L, 2) at times (T,)."""
    edges = graph.tolist()
    pairs = torch.tensor(
        [(a, b) for a, b in combinations(range(len(edges)), 2) if set(edges[a]) & set(edges[b])], dtype=torch.int64
    ).reshape(-1, 2)
    # 0 where a limb begins in the common node, 1 where it ends there.
    sides = torch.tensor(
        [[edges[limb].index(*(set(edges[a]) & set(edges[b]))) for limb in (a, b)] for a, b in pairs.tolist()],
        dtype=torch.int64,
    ).reshape(-1, 2)
    share = round(_ROOT_SHARE * (curves.shape[2] - 1))
    roots = torch.stack((curves[:, :, share] - curves[:, :, 0], curves[:, :, -1 - share] - curves[:, :, -1]), dim=2)
    first, second = (roots[:, pairs[:, k], sides[:, k]] for k in (0, 1))
    sine, cosine = torch.linalg.cross(first, second, dim=-1).norm(dim=-1), (first * second).sum(-1)
    known = (first.norm(dim=-1) > 0) & (second.norm(dim=-1) > 0)
    angles = torch.where(known, torch.atan2(sine, cosine), torch.nan)
    absent = curves.isnan().flatten(2).any(-1)
    return SpineMeasurements(
        times=times,
        lengths=torch.where(absent, torch.nan, curve_lengths(curves)),
        radii=radii.mean(-1),
        pairs=pairs.to(graph.device),
        angles=angles,
    )
