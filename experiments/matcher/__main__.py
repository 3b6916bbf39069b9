"""``python -m experiments.matcher -o FOLDER``: train the matcher of range scans."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..matcher.shards import make_shards
from ..matcher.train import TrainConfig, train
from ..matcher.weights import export_weights


def main() -> None:
    """Make pairs, train on them, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of pairs, checkpoint and curve")
    parser.add_argument("--pairs", type=int, default=5000)
    parser.add_argument("--held-out", type=int, default=100, help="pairs of kinds that are never trained on")
    parser.add_argument("--rigs", type=Path, help="folder of rigs (.glb) that are drawn as well")
    parser.add_argument("--people", type=int, default=0, help="of the body model anny, drawn as well in each file")
    parser.add_argument("--begin", type=Path, help="weights to start from")
    for name in ("minutes", "rate"):
        parser.add_argument(f"--{name}", type=float, default=getattr(TrainConfig, name))
    for name in ("steps", "batch", "processes", "every", "seed"):
        parser.add_argument(f"--{name}", type=int, default=getattr(TrainConfig, name))
    parser.add_argument("--device", default=TrainConfig.device)
    options = parser.parse_args()
    workers = max(options.processes, 1)
    files = make_shards(
        options.output / "pairs", options.pairs, options.seed, workers, rigs=options.rigs, people=options.people
    )
    held_out = make_shards(options.output / "held_out", options.held_out, options.seed, workers, held_out=True)
    names = ("minutes", "steps", "rate", "batch", "processes", "every", "seed", "device")
    config = TrainConfig(**{name: getattr(options, name) for name in names})
    train(files, held_out, options.output, config, options.begin)
    export_weights(options.output, options.output / "scan_matcher.safetensors")


if __name__ == "__main__":
    main()
