"""``torchreg label``: clouds and depth pictures to training data for pose networks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from torchreg.cli.align_options import NanPolicy, Scale
from torchreg.cli.cameras import DepthOptions
from torchreg.cli.known_options import Initializer, read_initializer
from torchreg.cli.outputs import Force, Quiet, check_outputs, written_to
from torchreg.cli.reporting import interruption, reporting
from torchreg.cli.shape_argument import Shape, ShapeOptions


@reporting
def label(
    shape: Shape,
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="The clouds, metres: files, which are put in the order of the numbers in their names, one folder of "
            "them, or one .npz of frames. With --depth depth pictures, folders or patterns of them.",
        ),
    ],
    output: Annotated[Path, written_to("FOLDER", "Labels are written here; created where it is missing.")] = Path(
        "labels"
    ),
    *,
    start: Annotated[
        Path | None, typer.Option(help="Pose of the first frame, as for align; searched by default.")
    ] = None,
    initializer: Initializer = None,
    trusted: Annotated[
        float, typer.Option(help="Poses less sure than this are not started from: the next frame is searched.")
    ] = 0.5,
    views: DepthOptions,
    nan_policy: NanPolicy = "raise",
    scale: Scale = 1.0,
    options: ShapeOptions,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Label point clouds, or depth pictures, with poses, keypoints, parts and confidence.

    Each frame gives label_NUMBER.safetensors and .json; torchreg.datasets.pose_labels.PoseLabels reads them for torch.

    Exit codes: 0; 2 for an error; 130 for Ctrl-C, which leaves the labels of the finished frames.
    """
    from tqdm import tqdm

    from torchreg._checks import check_positive

    check_positive(scale, "--scale")
    views.check()
    sequence = views.frames(frames, scale, nan_policy)
    with tqdm(total=len(sequence), unit="frame", desc="reading", leave=False, disable=quiet) as bar:
        from torchreg.alignment.pose_initializer import PoseInitializer
        from torchreg.alignment.pseudo_labels import label_frames
        from torchreg.datasets.pose_labels import label_path
        from torchreg.storage import load_pose

        output.mkdir(exist_ok=True)
        paths = [label_path(output, number) for number in range(len(sequence))]
        check_outputs([path.with_suffix(ending) for path in paths for ending in (".safetensors", ".json")], force)
        model = options.load(shape)
        first = None if start is None else load_pose(start, model)
        network = PoseInitializer(model, proposer=read_initializer(initializer, model))
        done = 0
        try:
            for found in label_frames(network, sequence, trusted=trusted, start=first):
                written = found.save(output, done)
                if not quiet:
                    bar.write(f"{sequence.names[done]}: confidence {float(found.confidence):.2f} -> {written}")
                done += 1
                bar.update()
        except KeyboardInterrupt:
            raise interruption(f"{done} of {len(sequence)} frames are labeled") from None
