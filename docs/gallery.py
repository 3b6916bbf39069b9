"""Draws the pictures of the gallery from built-in data: python docs/gallery.py --output docs/images/gallery.

With --data FOLDER, a folder with samba.npz and range_pairs, captured data are drawn too, into --output.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np
import torch

import torchreg as tr
from torchreg.datasets.creatures import creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose, surface_skin
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.viz.figures import bending_picture, watch
from torchreg.viz.spines import save_spine_movie
from torchreg.viz.strips import annealing_strip, convergence_figure, registration_strip, spine_strip

HERE = Path(__file__).parent


def draw_alignment(folder, smoke):
    """A hand whose start was off, as sigma shrinks; the paper's figure of the annealing."""
    hand = tr.Hand()
    generator = torch.Generator().manual_seed(4)
    truth = random_hand_pose(hand, generator)
    cloud = make_hand_cloud(hand, truth, num_points=700, outlier_ratio=0.3, camera=torch.zeros(3), generator=generator)
    away = 0.25 * torch.randn(hand.num_dofs, generator=generator) * (torch.arange(hand.num_dofs) > 5)
    start = hand.clamp(truth + away)
    start[:3] += torch.tensor([0.02, -0.015, 0.02])
    found = {}
    for name, steps in (("5 steps of sigma", 5), ("10 steps of sigma", 10)):
        schedule = tr.SigmaSchedule.geometric(0.03, 0.003, 2 if smoke else steps)
        found[name] = tr.align(
            hand, cloud.points, start, config=tr.AlignConfig(schedule=schedule, search="never" if smoke else "auto")
        )
    skin = None if smoke else surface_skin(hand)
    first = found["10 steps of sigma"]
    annealing_strip(folder / "annealing.png", hand, cloud.points, first, start=start, skin=skin)
    distance = {
        name: [1000 * float(r.sigma[0]) for r in result.history if r.stage == "em"] for name, result in found.items()
    }
    convergence_figure(folder / "sigma.png", distance, ylabel="sigma, mm")
    error = (first.keypoints - hand.keypoints(truth)).norm(dim=-1).mean().detach()
    return f"keypoints {1000 * float(error):.1f} mm off"


def draw_registration(folder, smoke):
    """Two scans of a jointed toy: its parts found, errors against the truth in millimetres."""
    scanner = DepthScanner(num_points=800 if smoke else 6000)
    pair = jointed_toy(2, seed=5, scanner=scanner, step=math.radians(25)).pair(0, 1)
    found = tr.register(pair.source, pair.target, 6 if smoke else 10, 25 if smoke else 50)
    target = tr.TriangleMesh(pair.target.points, pair.target.faces)
    errors = 1000 * (found.deformed - pair.truth).norm(dim=-1)
    registration_strip(folder / "registration.png", found, target, errors=errors, unit="mm")
    curves = {"distance": [record.distance for record in found.history], "joints": [r.joint for r in found.history]}
    convergence_figure(folder / "registration_cost.png", curves, ylabel="squared shares of the diagonal")
    return f"median error {float(pair.error(found.deformed).median()):.2%} of the diagonal"


def draw_spine(folder, smoke):
    """A starfish meshed anew in every frame: consistent limb identities."""
    creature = creature_sequence(num_frames=3 if smoke else 16, resolution=48 if smoke else 96, seed=1)
    meshes = list(creature.meshes)
    spine = tr.extract_spine(meshes, workers=1)
    spine_strip(folder / "spine.png", spine, meshes)
    save_spine_movie(folder / "spine.gif", spine, meshes, fps=8.0)
    same = sum(own == whole for own, whole in zip(spine.own_topologies, spine.topologies, strict=True))
    return f"{spine.num_tips} tips; {same} of {len(meshes)} frames have the tree by themselves"


def draw_bending(folder, smoke):
    """The skin at a joint, sliding and near rigid; figure 2 of the first paper."""
    bending_picture(folder / "bending.png", (2.0,) if smoke else (2.0, 10.0))
    return "a = 2 and a = 10"


def draw_captured(folder, data):
    """A captured dancer: a registered pair of range scans, and the spine of some frames."""
    pair = np.load(data / "range_pairs" / "samba_g4_f16.npz")
    source, target = (
        tr.RangeScan(torch.from_numpy(pair[f"{name}_points"]).float(), torch.from_numpy(pair[f"{name}_faces"]).long())
        for name in ("source", "target")
    )
    found = tr.register(source, target, 15, 60)
    mesh = tr.TriangleMesh(target.points, target.faces)
    registration_strip(folder / "dancer.png", found, mesh, view=_upright(torch.cat([source.points, target.points])))
    samba = np.load(data / "samba.npz")
    faces = torch.from_numpy(samba["faces"]).long()
    meshes = [tr.TriangleMesh(torch.from_numpy(vertices).float(), faces) for vertices in samba["vertices"][::6]]
    view = _upright(torch.cat([mesh.vertices for mesh in meshes]))
    spine_strip(folder / "dancer_spine.png", tr.extract_spine(meshes), meshes, view=view)
    return f"median distance {float(found.distances.median() / source.diagonal):.2%} of the diagonal"


def _upright(points):
    """Return a view with y up, from before and a little above."""
    lower, upper = points.amin(0), points.amax(0)
    away = torch.nn.functional.normalize(torch.tensor([0.5, 0.3, 1.0]), dim=0) * 3 * (upper - lower).norm()
    return watch(points, camera=(lower + upper) / 2 + away, up=torch.tensor([0.0, 1.0, 0.0]), size=(300, 300))


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=HERE / "images" / "gallery", help="folder of the pictures")
    parser.add_argument("--data", type=Path, help="folder with captured data; without it they are skipped")
    parser.add_argument("--smoke", action="store_true", help="small and coarse, in seconds")
    parser.add_argument("--only", nargs="*", help="names of pictures: bending, alignment, registration, spine")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    jobs = {
        "bending": draw_bending, "alignment": draw_alignment, "registration": draw_registration, "spine": draw_spine,
    }  # fmt: skip
    for name in options.only or jobs:
        began = time.perf_counter()
        said = jobs[name](options.output, options.smoke)
        print(f"{name}: {said} ({time.perf_counter() - began:.1f} s)")
    if options.data is None:
        print("captured data: skipped, no --data")
    else:
        print(f"captured data: {draw_captured(options.output, options.data)}")


if __name__ == "__main__":
    main()
