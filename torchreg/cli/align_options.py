"""Common arguments of commands that fit a shape to point clouds, and their readers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import check_used
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.alignment.fit.annealed_em import SigmaSchedule
    from torchreg.alignment.results import AlignResult
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.tracking.results import TrackResult

Sigma = Annotated[
    str | None, typer.Option(metavar="START:STOP:STEPS", help="Widths of the EM, metres, as in 0.02:0.005:5.")
]
Outlier = Annotated[str, typer.Option(help="Outlier class: limit, or volume for eq. 18 of the paper.")]
Search = Annotated[str, typer.Option(help="Look for better poses around the start: auto, always or never.")]
NanPolicy = Annotated[str, typer.Option(help="Non-finite points: raise, or omit.")]
Time = Annotated[
    float | None,
    typer.Option(help="Seconds of the animation of a .glb or .gltf file at which it is read; by default at rest."),
]
Frame = Annotated[
    int | None, typer.Option(help="Number of the keyframe of the animation of a .glb or .gltf file, for --time.")
]
Scale = Annotated[
    float, typer.Option(help="Metres per unit of the files (clouds, meshes, calibrations); 0.001 for millimeters.")
]

FitShape = Annotated[
    bool,
    typer.Option(
        "--fit-shape",
        help="Also fit the shape's coefficients, as of a body to a person; of a rig without any the lengths and radii "
        "of its parts.",
    ),
]
Clothed = Annotated[
    str,
    typer.Option(
        help="Clothes on a body fitted with --fit-shape: auto where the data are likelier with them, yes, or no."
    ),
]
Support = Annotated[
    str, typer.Option(help="A table or a floor that the scanned thing stands on: auto leaves it out, keep keeps it.")
]


def fitted_shape(shape: ArticulatedShape, wanted: bool) -> ArticulatedShape:
    """Return a shape whose coefficients can be fitted, where that is wanted."""
    return shape.with_bone_coefficients() if wanted and not shape.coefficient_names else shape


def read_clothed(text: str, fit_shape: bool) -> bool | str:
    """Return what `align` takes as ``clothed``; clothes need a fitted body."""
    from torchreg._checks import check_choice

    check_used(fit_shape, "--fit-shape", {"--clothed": text if text != "auto" else None})
    check_choice(text, "--clothed", ("auto", "yes", "no"))
    return {"yes": True, "no": False}.get(text, text)


def read_schedule(text: str | None) -> SigmaSchedule | None:
    """Return the schedule that START:STOP:STEPS describes, None for None."""
    if text is None:
        return None
    from torchreg.alignment.fit.annealed_em import SigmaSchedule

    try:
        start, stop, steps = text.split(":")
        values = float(start), float(stop), int(steps)
    except ValueError:
        raise InputError(f"--sigma must be START:STOP:STEPS as in 0.02:0.005:5, got {text!r}") from None
    return SigmaSchedule.geometric(*values)


def read_cloud(
    path: Path, scale: float, nan_policy: str, time: float | None = None, frame: int | None = None
) -> Tensor:
    """Return the points (M, 3) of a file, metres."""
    from torchreg._checks import check_positive
    from torchreg.io.points import load_points

    check_positive(scale, "--scale")
    return load_points(path, scale=scale, nan_policy=nan_policy, time=time, frame=frame).points


def cloud_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files that are meant: those of a folder, or that match a pattern, in the order of their numbers."""
    import glob

    from torchreg.io.frames import frames_in
    from torchreg.io.natural_order import natural_sorted

    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += natural_sorted(frames_in(path))
        elif not path.exists() and (matching := glob.glob(str(path))):
            files += natural_sorted(Path(name) for name in matching)
        else:
            files.append(path)
    return files


def alignment_summary(result: AlignResult) -> str:
    """Return status, confidence, what is doubtful, inliers, residual and cost of an alignment in one line."""
    near = result.distances[result.inliers]
    rms = f"rms {1e3 * float(near.square().mean().sqrt()):.2f} mm, " if len(near) else ""
    counts = f"{len(near)} of {len(result.distances)} points inliers"
    sure = "" if result.confidence is None else f" (confidence {float(result.confidence):.2f})"
    doubt = f"; {result.doubt}" if result.doubt else ""
    return f"{result.statuses[0].value}{sure}, {counts}, {rms}cost {float(result.cost):.4g}{doubt}"


def person_summary(shape: ArticulatedShape, result: AlignResult | TrackResult) -> str:
    """Return the first coefficients that were fitted, with their standard deviations; nothing where none were."""
    if result.coefficients is None or result.coefficient_covariance is None:
        return ""
    worn = getattr(result, "clothing_offset", None)
    clothes = [] if worn is None else [f"clothes {1e3 * float(worn.mean()):.0f} mm off the skin on average"]
    rows = zip(
        shape.coefficient_names, result.coefficients.tolist(),
        result.coefficient_covariance.diagonal().sqrt().tolist(), strict=True,
    )  # fmt: skip
    known = [f"{name} {value:.2f} +- {std:.2f}" for name, value, std in list(rows)[:6]]
    return ", ".join(known + clothes)
