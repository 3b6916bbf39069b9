"""Draws the pictures of the gallery from built-in data: python docs/gallery.py --output docs/images/gallery.

With --data FOLDER, a folder with samba.npz and range_pairs, captured data are drawn too, into --output.
"""

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchreg as tr
from torchreg.datasets.creatures import creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose, surface_skin
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.viz.animation import animate_scene
from torchreg.viz.bone_colors import error_colors, weight_colors
from torchreg.viz.figures import bending_picture, draw_scene, new_figure, save_picture, scene_view, watch
from torchreg.viz.posed_scenes import posed_scene
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Meshes, MovingMesh, Scene
from torchreg.viz.spines import save_spine_movie

HERE = Path(__file__).parent
PANEL = 300  # pixels
SOURCE, TARGET = (0.80, 0.78, 0.76), (0.55, 0.63, 0.75)


def draw_row(path, panels, *, view=None, margin=0.0, unit="", largest=None):
    """Draw scenes, each (caption, scene, frame), side by side; with ``largest``, a scale of errors on the right."""
    if view is None:
        view = watch(torch.cat([scene.sample() for _, scene, _ in panels]), up=panels[0][1].up, size=(PANEL, PANEL))
    width, height = int((len(panels) + margin) * PANEL), int(PANEL / 0.91)
    figure, _ = new_figure(width, height, 0)
    for column, (caption, scene, frame) in enumerate(panels):
        ax = figure.add_axes((column * PANEL / width, 0.09, PANEL / width, 0.91))
        draw_scene(replace(scene, title=""), frame, ax, view=view)
        figure.text((column + 0.5) * PANEL / width, 0.03, caption, ha="center", fontsize=10)
    if largest is not None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import ListedColormap, Normalize

        shades = error_colors(torch.linspace(0, 1, 256), 1.0).numpy()
        scale = ScalarMappable(Normalize(0, largest), ListedColormap(shades))
        figure.colorbar(scale, cax=ax.inset_axes((1.06, 0.1, 0.05, 0.8)), label=f"error{f', {unit}' if unit else ''}")
    save_picture(figure, path)


def annealing_row(path, shape, points, result, start, skin, columns=5):
    """Draw the shape on the data as sigma shrinks, from the start to the end; figure 4 of the first paper."""
    chosen = np.unique(np.linspace(0, len(result.history) - 1, columns - 1).round().astype(int))
    steps = [("start", start)]
    for record in (result.history[step] for step in chosen):
        em = f"EM, sigma {1000 * float(record.sigma[0]):.1f} mm"
        steps.append((em if record.stage == "em" else f"surface fit, step {record.step + 1}", record.pose[0]))
    scenes = [posed_scene(shape, pose[None], [points], [result.inliers], skin=skin, up=result.up) for _, pose in steps]
    draw_row(path, [(name, scene, 0) for (name, _), scene in zip(steps, scenes, strict=True)])


def registration_row(path, result, target, *, errors=None, unit="", view=None):
    """Draw source, target, and the moved source by bones and by error."""
    known = (result.distances if errors is None else errors).detach().nan_to_num(0.0, 0.0).clamp(min=0)
    largest = float(known.double().quantile(0.98)) or 1.0
    moved = result.deformed.detach()
    panels = [
        ("source", MovingMesh("source", result.points, result.faces, SOURCE)),
        ("target", MovingMesh("target", target.vertices, target.faces, TARGET)),
        ("moved, by bones", MovingMesh("bones", moved, result.faces, weight_colors(result.weights).clamp(0, 1))),
        ("moved, by error", MovingMesh("error", moved, result.faces, error_colors(known, largest))),
    ]
    row = [(name, Scene("", (layer,), up=result.up), 0) for name, layer in panels]
    draw_row(path, row, view=view, margin=0.35, unit=unit, largest=largest)


def spine_row(path, spine, meshes, *, columns=4, view=None):
    """Draw a spine over time, limbs in constant colors and numbers."""
    scene = result_scene(spine, data=meshes)
    view = scene_view(scene, size=(PANEL, PANEL)) if view is None else view
    chosen = np.unique(np.linspace(0, len(meshes) - 1, columns).round().astype(int))
    draw_row(path, [(f"frame {number}", scene, number) for number in chosen.tolist()], view=view)


def convergence_figure(path, curves, ylabel):
    """Plot numbers over steps, a line for each name."""
    from matplotlib.ticker import LogFormatter, MaxNLocator

    figure, _ = new_figure(520, 320, 0)
    figure.set_layout_engine("constrained")
    ax = figure.add_subplot()
    for name, values in curves.items():
        line = np.where(np.asarray(values, dtype=float) > 0, values, np.nan)
        if np.isfinite(line).any():
            ax.plot(np.arange(1, len(line) + 1), line, marker="o", markersize=3, linewidth=1.4, label=name)
    ax.set(xlabel="step", ylabel=ylabel, yscale="log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for setter in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        setter(LogFormatter(labelOnlyBase=False, minor_thresholds=(2.0, 0.5)))
    ax.grid(True, which="both", alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    if ax.lines:
        ax.legend(frameon=False)
    save_picture(figure, path)


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
    annealing_row(folder / "annealing.png", hand, cloud.points, first, start, skin)
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
    registration_row(folder / "registration.png", found, target, errors=errors, unit="mm")
    curves = {"distance": [record.distance for record in found.history], "joints": [r.joint for r in found.history]}
    convergence_figure(folder / "registration_cost.png", curves, ylabel="squared shares of the diagonal")
    return f"median error {float(pair.error(found.deformed).median()):.2%} of the diagonal"


def draw_spine(folder, smoke):
    """A starfish meshed anew in every frame: consistent limb identities."""
    creature = creature_sequence(num_frames=3 if smoke else 16, resolution=48 if smoke else 96, seed=1)
    meshes = list(creature.meshes)
    spine = tr.extract_spine(meshes, workers=1)
    spine_row(folder / "spine.png", spine, meshes)
    save_spine_movie(folder / "spine.gif", spine, meshes, fps=8.0)
    same = sum(own == whole for own, whole in zip(spine.own_topologies, spine.topologies, strict=True))
    return f"{spine.num_tips} tips; {same} of {len(meshes)} frames have the tree by themselves"


def rig_movie(path, rig, meshes, up=None):
    """Draw each frame's own mesh, to the right of it the rig by bones; return what is said of the rig."""
    source = Meshes("source", meshes, TARGET)
    camera, middle, upright = Scene("", (source,), up=up).camera()
    right = torch.nn.functional.normalize(torch.linalg.cross(middle - camera, upright), dim=0)
    points = torch.cat([mesh.vertices for mesh in meshes]).to(right) @ right
    beside = (1.1 * (points.amax() - points.amin()) * right).float()
    colors = weight_colors(rig.weights).clamp(0, 1).float()
    posed = MovingMesh("rig", rig.vertices().float() + beside, rig.shape.file_skin().faces, colors)
    scene = Scene("", (source, posed))
    view = watch(scene.sample(), camera=camera + beside / 2, up=upright, size=(2 * PANEL, PANEL))
    animate_scene(path, scene, 6.0, view=view)
    return f"{len(rig.joints)} bones; {float(rig.errors.nan_to_num(0.0).max()):.2%} of the diagonal in the worst frame"


def draw_rig(folder, smoke):
    """A starfish meshed anew in every frame, beside its rig, by bones."""
    meshes = list(creature_sequence(num_frames=2 if smoke else 8, resolution=40 if smoke else 96, seed=1).meshes)
    align = replace(tr.RegisterConfig().align, num_samples=300)
    config = tr.RigConfig(num_points=500, rounds=4, register=tr.RegisterConfig(align=align, num_samples=500))
    return rig_movie(folder / "rig.gif", tr.rig_sequence(meshes, config=config if smoke else None), meshes)


def draw_bending(folder, smoke):
    """The skin at a joint, sliding and near rigid; figure 2 of the first paper."""
    bending_picture(folder / "bending.png", (2.0,) if smoke else (2.0, 10.0))
    return "a = 2 and a = 10"


def draw_captured(folder, data):
    """A captured dancer: a registered pair of range scans, and spine and rig of some frames."""
    pair = np.load(data / "range_pairs" / "samba_g4_f16.npz")
    source, target = (
        tr.RangeScan(torch.from_numpy(pair[f"{name}_points"]).float(), torch.from_numpy(pair[f"{name}_faces"]).long())
        for name in ("source", "target")
    )
    found = tr.register(source, target, 15, 60)
    mesh = tr.TriangleMesh(target.points, target.faces)
    registration_row(folder / "dancer.png", found, mesh, view=_upright(torch.cat([source.points, target.points])))
    samba = np.load(data / "samba.npz")
    faces = torch.from_numpy(samba["faces"]).long()
    meshes = [tr.TriangleMesh(torch.from_numpy(vertices).float(), faces) for vertices in samba["vertices"][::6]]
    view = _upright(torch.cat([mesh.vertices for mesh in meshes]))
    spine_row(folder / "dancer_spine.png", tr.extract_spine(meshes), meshes, view=view)
    rig = rig_movie(folder / "dancer_rig.gif", tr.rig_sequence(meshes), meshes, up=(0.0, 1.0, 0.0))
    return f"median distance {float(found.distances.median() / source.diagonal):.2%} of the diagonal; rig: {rig}"


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
    parser.add_argument("--only", nargs="*", help="names of pictures: bending, alignment, registration, spine, rig")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    jobs = {
        "bending": draw_bending, "alignment": draw_alignment, "registration": draw_registration, "spine": draw_spine,
        "rig": draw_rig,
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
