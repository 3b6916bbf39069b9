"""``python -m experiments.matcher -o FOLDER``: train the matcher of range scans."""

from __future__ import annotations

import argparse
from functools import partial
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
    parser.add_argument("--rigs", type=Path, help="folder of rigs (.glb, index.csv) that are drawn as well")
    parser.add_argument("--people", type=int, default=0, help="of the body model anny, drawn as well in each file")
    parser.add_argument("--begin", type=Path, help="weights or checkpoint to start from")
    for name in ("minutes", "rate"):
        parser.add_argument(f"--{name}", type=float, default=getattr(TrainConfig, name))
    for name in ("steps", "batch", "processes", "every", "seed"):
        parser.add_argument(f"--{name}", type=int, default=getattr(TrainConfig, name))
    parser.add_argument("--device", default=TrainConfig.device)
    options = parser.parse_args()
    workers = max(options.processes, 1)
    make = partial(make_shards, seed=options.seed, workers=workers, rigs=options.rigs)
    held_out = make(options.output / "held_out", options.held_out, held_out=True)
    files = make(options.output / "pairs", options.pairs, people=options.people)
    names = ("minutes", "steps", "rate", "batch", "processes", "every", "seed", "device")
    config = TrainConfig(**{name: getattr(options, name) for name in names})
    train(files, held_out, options.output, config, options.begin)
    export_weights(options.output, options.output / "scan_matcher.safetensors")


if __name__ == "__main__":
    main()
