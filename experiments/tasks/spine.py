"""One spine of a sequence of surfaces: tips per frame, trees before and after, constant names."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.creatures import OCTOPUS, STARFISH, CreatureSequence, creature_sequence
from torchreg.viz.figures import save_scene
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.spine_gltf import save_spine_animation

from ..errors import SkippedTrial
from ..library_settings import with_settings
from ..registry import Bench, TrialOutcome
from ..schema import SpineTrial
from ..tasks.peers import peer

PICTURE_PIXELS = (300, 300)


@dataclass(frozen=True)
class Sequence:
    """Surfaces and their truth.

    Args:
        meshes: T surfaces.
        tips: true number of tips; 0 if unknown.
        named: tells in which frames (T,) of a spine every tip keeps its name.
    """

    meshes: tuple[tr.TriangleMesh, ...]
    tips: int
    named: Callable[[tr.SpineSequence], Tensor]


def run(config: SpineTrial, bench: Bench) -> TrialOutcome:
    """Return the scores of the spine of a sequence."""
    begin = time.perf_counter()
    sequence = make_sequence(config)
    seconds = {"setup": time.perf_counter() - begin}
    begin = time.perf_counter()
    if config.method == "skeletor":
        counts = [_peer_tips(mesh) for mesh in sequence.meshes]
        seconds["total"] = time.perf_counter() - begin
        return TrialOutcome(_tip_metrics(counts, sequence), seconds, {"own_tips": [float(count) for count in counts]})
    settings = tr.SpineConfig.paper() if config.method == "paper" else tr.SpineConfig()
    spine = tr.extract_spine(sequence.meshes, config=with_settings(settings, config.config), workers=1)
    seconds["total"] = time.perf_counter() - begin
    counts = [count_tips(topology) for topology in spine.own_topologies]
    outcome = TrialOutcome(
        _tip_metrics(counts, sequence) | _metrics(spine, sequence),
        seconds,
        {
            "own_tips": [float(count) for count in counts],
            "tips": [float(count_tips(topology)) for topology in spine.topologies],
        },
    )
    if config.pictures:
        outcome.artifacts = _artifacts(sequence, spine, bench)
    return outcome


def make_sequence(config: SpineTrial) -> Sequence:
    """Return the surfaces of a trial.

    Raises:
        SkippedTrial: if a file is asked for that is not here.
    """
    if config.creature == "file":
        return _from_file(Path(config.folder) / f"{config.name}.npz", config.frames)
    form = STARFISH if config.creature == "starfish" else OCTOPUS
    made = creature_sequence(
        form, config.frames, touching=config.touching, noise=config.noise, resolution=config.resolution,
        seed=config.seed,
    )  # fmt: skip
    return Sequence(made.meshes, form.num_arms, lambda spine: _arms_named(spine, made))


def _from_file(path: Path, frames: int) -> Sequence:
    if not path.is_file():
        raise SkippedTrial(f"there is no file {path}; say where the data lie with folder=FOLDER")
    with np.load(path, allow_pickle=False) as file:
        every = max(1, len(file["vertices"]) // frames) if frames else 1
        vertices = torch.from_numpy(file["vertices"][::every])
        faces = torch.from_numpy(file["faces"].astype(np.int64))

    def named(spine: tr.SpineSequence) -> Tensor:
        """Return the mask (T,) of frames in which the vertex nearest to each tip in the reference is nearest again."""
        tips, positions = spine.tips.double(), vertices.double()
        nearest = torch.cdist(tips[spine.reference], positions[spine.reference]).argmin(-1)
        return (torch.cdist(tips, positions[:, nearest]).argmin(-1) == torch.arange(spine.num_tips)).all(-1)

    return Sequence(tuple(tr.TriangleMesh(frame, faces) for frame in vertices), 0, named)


def count_tips(topology: str) -> int:
    """Return the number of tips of a tree in the form of `Skeleton.topology`: its leaves."""
    return topology.count("()")


def _tip_metrics(counts: list[int], sequence: Sequence) -> dict[str, float]:
    mode = max(set(counts), key=counts.count)
    metrics = {"tips_mode": float(mode), "own_tips_stable": sum(count == mode for count in counts) / len(counts)}
    return metrics | ({"tips_right": float(mode == sequence.tips)} if sequence.tips else {})


def _metrics(spine: tr.SpineSequence, sequence: Sequence) -> dict[str, float]:
    final = max(set(spine.topologies), key=spine.topologies.count)
    frames = len(sequence.meshes)
    right = spine.num_tips == sequence.tips or not sequence.tips
    return {
        "tips": float(spine.num_tips),
        "trees_before": float(len(set(spine.own_topologies))),
        "trees_after": float(len(set(spine.topologies))),
        "own_tree": sum(topology == final for topology in spine.own_topologies) / frames,
        "named": float(sequence.named(spine).double().mean()) if right else 0.0,
        "frames": float(frames),
        "vertices": float(np.mean([mesh.num_vertices for mesh in sequence.meshes])),
    }


def _arms_named(spine: tr.SpineSequence, truth: CreatureSequence) -> Tensor:
    """Return the mask (T,) of frames in which every limb is nearest to the arm that it is nearest to on average."""
    curves, axes = spine.curves[:, : spine.num_tips].double(), truth.curves.double().flip(2)
    sample = torch.linspace(0, axes.shape[2] - 1, curves.shape[2]).round().long()
    apart = (curves.unsqueeze(2) - axes[:, None, :, sample]).norm(dim=-1).mean(-1)
    return (apart.argmin(-1) == apart.mean(0).argmin(-1)).all(-1)


def _peer_tips(mesh: tr.TriangleMesh) -> int:
    """Return the number of leaves of the skeleton that skeletor finds, a program of its own under another licence."""
    skeletor = peer("skeletor")
    import trimesh

    body = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    table = skeletor.skeletonize.by_wavefront(body, waves=1, step_size=1, progress=False).swc
    return int((~table.node_id.isin(table.parent_id)).sum())


def _artifacts(sequence: Sequence, spine: tr.SpineSequence, bench: Bench) -> dict[str, str]:
    shown = result_scene(spine, data=sequence.meshes)
    save_scene(bench.file("spine.png"), shown, spine.reference, size=PICTURE_PIXELS)
    save_spine_animation(bench.file("spine.glb"), spine.model)
    return {"spine": "spine.png", "spine, moving": "spine.glb"}
