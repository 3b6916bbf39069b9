"""Rigs aligned from a start: python benchmarks/rig_starts.py FILE.glb ... [--count 18] [--threads 1].

Every rig is posed at random, every bone turned by .25 rad (standard deviation) about each axis; its data are 2,000
points all over the surface with noise of .3 % of the size. Starts are off by .1, .2 and .35 rad about each axis. Prints
the mean distance of the skin's vertices from their true places, shares of the size, the confidence and CPU seconds,
after the descent alone and with the search that `align` adds where it is needed.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch

import torchreg as tr
from torchreg.geometry.mesh import sample_surface

SPREAD, NOISE, NUM_DATA, OFFSETS = 0.25, 0.003, 2000, (0.1, 0.2, 0.35)


def turned(shape: tr.ArticulatedShape, pose: torch.Tensor, std: float, generator: torch.Generator) -> torch.Tensor:
    """Return a pose whose joints are turned at random."""
    pose = pose.clone()
    pose[6:] += std * torch.randn(shape.num_dofs - 6, generator=generator)
    return shape.clamp(pose)


def rows(file: Path, count: int) -> list[tuple[float, str, float, float, float]]:
    """Return offset, search, error, confidence and CPU seconds of ``count`` alignments with either search."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tr.errors.FileWarning)
        shape = tr.ArticulatedShape.from_gltf(file)
    skin, generator, found = shape.file_skin(), torch.Generator().manual_seed(0), []
    for number in range(count):
        offset = OFFSETS[number % len(OFFSETS)]
        pose = turned(shape, shape.rest_pose(), SPREAD, generator)
        vertices = skin(pose).detach()
        size = float((vertices.amax(0) - vertices.amin(0)).norm())
        data = sample_surface(tr.TriangleMesh(vertices, skin.faces), NUM_DATA, generator)[0]
        data = data + NOISE * size * torch.randn(data.shape, generator=generator)
        start = turned(shape, pose, offset, generator)
        for search in ("never", "auto"):
            begin = time.process_time()
            result = tr.align(shape, data, start, config=tr.AlignConfig(search=search))
            seconds = time.process_time() - begin
            error = float((skin(result.pose) - vertices).norm(dim=-1).mean()) / size
            found.append((offset, search, error, float(result.confidence), seconds))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", help="rigged glTF files")
    parser.add_argument("--count", type=int, default=18, help="alignments of each")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    for file in options.files:
        found = rows(file, options.count)
        for offset in OFFSETS[: options.count]:
            for search in ("never", "auto"):
                chosen = torch.tensor([row[2:] for row in found if row[:2] == (offset, search)])
                error, confidence, seconds = chosen.mean(0).tolist()
                print(
                    f"{file.stem:20} {offset:4} rad  search {search:5}  error {error:6.2%}, most "
                    f"{float(chosen[:, 0].max()):6.2%}  confidence {confidence:.2f}  {seconds:.2f} CPU s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
