"""How well spines of what grows name its organs through time: births, ends, and who is who.

    python benchmarks/growing_spines.py                                     # made-up plants
    python benchmarks/growing_spines.py --data FOLDER --picture plant.png   # also scans of a plant, drawn
    python benchmarks/growing_spines.py --smoke                             # a small plant, to see that it runs

Plants (`datasets.plants`) of ten organs in 24 frames: eight appear, one falls off, two split a tip. Every frame is
meshed anew; every first, second and fourth one is taken. Names are matched one to one to the organs that they are
nearest to in most frames. "right" is the share of the organs' frames, of all in which an organ is there, in which the
tip of its name lies within 6 % of the diagonal of its own; "shown": the same, of frames whose name has a tip near an
organ (bar: 95 % of both for all frames). "births", "ends": share of organs whose first and last frame is right within
two (bar for all frames: all).

Scans from FOLDER/plants (files of clouds, in the order of the dates in their names) are named as well; there is no
truth for them, a table of tips is printed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.plants import GrowingPlant, PlantForm, growing_plant
from torchreg.geometry.cloud_surface import cloud_surface
from torchreg.solvers.assignment import assign
from torchreg.viz.figures import draw_scene, new_figure, save_picture, scene_view
from torchreg.viz.result_scenes import result_scene

BAR, WITHIN, NEAR, STEPS = 0.95, 2, 0.06, (1, 2, 4)


@dataclass(frozen=True)
class Row:
    """One plant.

    Args:
        seed: of it.
        step: every which frame is taken.
        organs: number of them, and of names.
        births, ends: share of organs within two frames.
        right: share of organs' frames.
        shown: share of names' frames.
        confidence: mean of it.
        seconds: of one frame, skeleton and all.
    """

    seed: int
    step: int
    organs: tuple[int, int]
    births: float
    ends: float
    right: float
    shown: float
    confidence: float
    seconds: float


def judged(spine: tr.SpineSequence, plant: GrowingPlant, step: int) -> dict[str, float]:
    """Return the figures of the spine of every so many frames of a plant."""
    truth = plant.tips[::step].double()
    alive = ~truth[..., 0].isnan()
    known = truth[alive]
    size = (known.amax(0) - known.amin(0)).norm()
    near = (spine.tips.double()[:, :, None] - truth[:, None]).norm(dim=-1) <= NEAR * size  # NaN is near nothing
    own = assign(-near.double().sum(0).mT)  # of each organ
    right = near[:, own.clamp_min(0), torch.arange(len(own))] & (own >= 0)
    numbers = torch.arange(len(truth))[:, None]
    first, last = torch.where(alive, numbers, len(truth)).amin(0), torch.where(alive, numbers, -1).amax(0)
    births, ends = (rows[own.clamp_min(0)] for rows in (spine.births, spine.ends))
    return {
        "births": float((((births - first).abs() <= WITHIN) & (own >= 0)).double().mean()),
        "ends": float((((ends - last).abs() <= WITHIN) & (own >= 0)).double().mean()),
        "right": float(right[alive].double().mean()),
        "shown": float((right & spine.found[:, own.clamp_min(0)]).sum() / (near.any(2) & spine.found).sum()),
    }


def row_of(plant: GrowingPlant, seed: int, step: int) -> Row:
    meshes = plant.meshes[::step]
    start = time.process_time()
    spine = tr.extract_spine(meshes, growing=True, workers=1)
    return Row(
        seed=seed,
        step=step,
        organs=(plant.tips.shape[1], spine.num_tips),
        confidence=float(spine.confidence.nanmean()),
        seconds=(time.process_time() - start) / len(meshes),
        **judged(spine, plant, step),
    )


def render(rows: Sequence[Row]) -> str:
    lines = [f"{'every':>5} {'seed':>4} {'organs':>6} {'names':>5} {'births':>6} {'ends':>6} {'right':>6} {'shown':>6} "
             f"{'confid.':>7} {'s/frame':>7}"]  # fmt: skip
    lines += [
        f"{row.step:5} {row.seed:4} {row.organs[0]:6} {row.organs[1]:5} {row.births:6.1%} {row.ends:6.1%} "
        f"{row.right:6.1%} {row.shown:6.1%} {row.confidence:7.3f} {row.seconds:7.2f}"
        for row in rows
    ]
    every = [row for row in rows if row.step == 1]
    mean = torch.tensor([[row.births, row.ends, row.right, row.shown] for row in every]).mean(0)
    passed = bool((mean[:2] == 1).all()) and bool((mean[2:] >= BAR).all())
    words = (f"{name} {value:.1%}" for name, value in zip(("births", "ends", "right", "shown"), mean, strict=True))
    return "\n".join([*lines, f"every frame, mean: {', '.join(words)}  {'pass' if passed else 'FAIL'}"])


def scanned(folder: Path, picture: Path | None) -> None:
    """Print the organs of scans of a plant, and draw them."""
    paths = [path for path in sorted(folder.glob("*")) if path.suffix.lower() in (".ply", ".xyz", ".pcd")]
    if not paths:
        print("scans: left out, as there is no --data FOLDER with clouds in its folder plants")
        return
    clouds = (tr.load_points(path).points for path in paths)
    meshes = [cloud_surface(points, path.name).mesh for path, points in zip(paths, clouds, strict=True)]
    spine = tr.extract_spine(meshes, growing=True)
    print(f"scans: {', '.join(path.stem for path in paths)}\n{organ_table(spine)}")
    if picture is not None:
        scene, size = result_scene(spine, data=meshes), 300
        view = scene_view(scene, size=(size, size))
        figure, axes = new_figure(size * len(meshes), size, len(meshes))
        for frame, ax in enumerate(axes):
            draw_scene(replace(scene, title=f"frame {frame}"), frame, ax, view=view)
        print(save_picture(figure, picture))


def organ_table(spine: tr.SpineSequence) -> str:
    """Return a line for each organ: its life, and in every frame its height above the lowest tip and its length."""
    lengths, heights = spine.measurements().lengths, spine.tips[..., 2]
    low = heights.nan_to_num(torch.inf).amin()

    def cell(frame: int, organ: int) -> str:
        if bool(heights[frame, organ].isnan()):
            return f"{'-':>21}"
        mark = "" if bool(spine.found[frame, organ]) else "?"
        height, length = float(heights[frame, organ] - low), float(lengths[frame, organ])
        return f"{height:7.1f} {length:6.1f} {float(spine.confidence[frame, organ]):5.2f}{mark:1}"

    head = "".join(f"{f'frame {frame}: height':>16}, len" for frame in range(len(heights)))
    rows = [
        f"{organ:5} {int(spine.births[organ]):5} {int(spine.ends[organ]):4} "
        + " ".join(cell(frame, organ) for frame in range(len(heights)))
        for organ in range(spine.num_tips)
    ]
    return "\n".join([f"organ birth  end {head} and confidence; ? is hidden", *rows])


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with clouds of a growing plant in its folder plants")
    parser.add_argument("--picture", type=Path, help="draw these scans and their organs")
    parser.add_argument("--plants", type=int, default=6, help="made-up ones, of seeds 0, 1, ... (default 6)")
    parser.add_argument("--smoke", action="store_true", help="one small plant")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows = []
    for seed in tqdm(range(1 if options.smoke else options.plants), desc="plants", leave=False, disable=None):
        form = PlantForm(num_leaves=2, num_branchlets=0, num_early=1, num_falling=0) if options.smoke else PlantForm()
        plant = growing_plant(form, 4 if options.smoke else 24, resolution=32 if options.smoke else 96, seed=seed)
        rows += [row_of(plant, seed, step) for step in (STEPS[:1] if options.smoke else STEPS)]
    print(render(sorted(rows, key=lambda row: (row.step, row.seed))))
    if options.data is not None:
        scanned(options.data / "plants", options.picture)
    return rows


if __name__ == "__main__":
    main()
