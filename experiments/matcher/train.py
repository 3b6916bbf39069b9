"""Training of the matcher: soft assignments against the truth, both ways, on one or several processes or a GPU."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import typer
from torch import Tensor, distributed, nn

from torchreg.registration.dense.scan_matcher import ScanMatcher, match_probabilities

from ..matcher.shards import PairBatch, PairStore, kind_names
from ..matcher.weights import load_weights

# Width of the Gaussian about the true place, share of the target's size: half of what tokens are apart.
_WIDTH = 0.025
# A match counts as right within this share of the target's size, as in what is reported of other matchers.
NEAR = 0.05


@dataclass(frozen=True)
class TrainConfig:
    """How the matcher is trained.

    Args:
        minutes: of training, in which the rate falls to nothing; what was trained before counts.
        steps: most of them; training ends with whatever comes first.
        batch: pairs per step, over all processes.
        rate: largest learning rate.
        processes: that share each step; one thread each.
        device: "cpu", or "cuda" with one process.
        every: steps between two validations.
        seed: of the network and of the order of pairs.
    """

    minutes: float = 40.0
    steps: int = 1_000_000
    batch: int = 8
    rate: float = 1e-3
    processes: int = 2
    device: str = "cpu"
    every: int = 200
    seed: int = 0


def assignment_loss(logits: Tensor, batch: PairBatch) -> Tensor:
    """Return the cross entropy, both ways, of soft assignments against Gaussians about the true places.

    A token that the other scan does not show should be hidden.
    """
    target_points = batch.target.at_tokens(batch.target.points)
    source_points = batch.source.at_tokens(batch.source.points)
    ways = (
        (logits[:, :-1], batch.source_truth, batch.source_visible, target_points),
        (logits.mT[:, :-1], batch.target_truth, batch.target_visible, source_points),
    )
    total = logits.new_zeros(())
    for rows, truth, visible, points in ways:
        logarithm = rows.log_softmax(2)
        aim = (-torch.cdist(truth, points).square() / (2 * _WIDTH**2)).softmax(2)
        match = -(aim * logarithm[..., :-1]).sum(2)
        total = total + torch.where(visible, match, -logarithm[..., -1]).mean()
    return total / 2


@dataclass(frozen=True)
class Scores:
    """How a matcher does on pairs.

    Args:
        right: share of visible tokens whose best match is right.
        loss: mean loss.
        recall: share of hidden tokens that are called hidden.
        precision: share of tokens called hidden that are.
    """

    right: float
    loss: float
    recall: float
    precision: float


@torch.no_grad()
def validate(net: ScanMatcher, pairs: PairStore, device: str = "cpu", size: int = 10) -> dict[int, Scores]:
    """Return scores by number of kind, and of all together under -1."""
    net.eval()
    rows: list[tuple[int, Tensor, float]] = []
    for first in range(0, len(pairs), size):
        batch = pairs.batch(torch.arange(first, min(first + size, len(pairs)))).to(device)
        logits = net(batch.source, batch.target)
        probability, hidden, _ = match_probabilities(logits)
        places = batch.target.at_tokens(batch.target.points)
        best = places.gather(1, probability.argmax(2, keepdim=True).expand(-1, -1, 3))
        right = (best - batch.source_truth).norm(dim=-1) < NEAR
        for index, kind in enumerate(batch.kinds.tolist()):
            visible, called = batch.source_visible[index], hidden[index] > 0.5
            counts = ((right[index] & visible), visible, (called & ~visible), ~visible, called)
            loss = float(assignment_loss(logits[index : index + 1], batch.rows(slice(index, index + 1))))
            rows.append((kind, torch.stack([count.sum() for count in counts]).double().cpu(), loss))
    net.train()
    found = {}
    for kind in [-1, *sorted({row[0] for row in rows})]:
        chosen = [row for row in rows if kind in (-1, row[0])]
        right, visible, hit, lost, called = torch.stack([row[1] for row in chosen]).sum(0).tolist()
        loss = sum(row[2] for row in chosen) / len(chosen)
        found[kind] = Scores(right / max(visible, 1), loss, hit / max(lost, 1), hit / max(called, 1))
    return found


def train(
    files: list[Path], held_out: list[Path], output: Path, config: TrainConfig, begin: Path | None = None
) -> None:
    """Train a matcher, or go on where an earlier run in the same folder ended.

    Args:
        files: of pairs to train on; those that are still being made are read from the first pass after that.
        held_out: of pairs to validate with.
        output: folder of ``checkpoint.pt`` and ``curve.jsonl``.
        config: see `TrainConfig`.
        begin: weights to start from, instead of random ones.
    """
    output.mkdir(parents=True, exist_ok=True)
    if config.processes == 1:
        _work(0, files, held_out, output, config, begin, None)
        return
    with tempfile.TemporaryDirectory() as folder:
        meeting = f"file://{folder}/meeting"
        torch.multiprocessing.spawn(
            _work, (files, held_out, output, config, begin, meeting), nprocs=config.processes, join=True
        )


class _Run:
    """The state of one process: network, optimizer, and how far it is."""

    def __init__(self, output: Path, config: TrainConfig, begin: Path | None) -> None:
        torch.manual_seed(config.seed)
        self.config, self.checkpoint = config, output / "checkpoint.pt"
        self.net = ScanMatcher(pretrained=False).to(config.device)
        self.step, self.seconds = 0, 0.0
        self.best, self.best_right = self.net.state_dict(), -1.0
        if begin is not None and not self.checkpoint.exists():
            self.net.load_state_dict(load_weights(begin))
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=config.rate, weight_decay=0.01)
        if self.checkpoint.exists():
            state = torch.load(self.checkpoint, weights_only=True, map_location=config.device)
            self.net.load_state_dict(state["net"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.step, self.seconds = state["step"], state["seconds"]
            self.best, self.best_right = state["best"], state["best_right"]

    def save(self, right: float) -> None:
        """Write the checkpoint, with the weights that got most tokens of the held-out pairs right so far."""
        if right > self.best_right:
            self.best = {name: value.detach().clone() for name, value in self.net.state_dict().items()}
            self.best_right = right
        part = self.checkpoint.with_suffix(".part")
        torch.save({
            "net": self.net.state_dict(), "optimizer": self.optimizer.state_dict(), "step": self.step,
            "seconds": self.seconds, "best": self.best, "best_right": self.best_right,
        }, part)  # fmt: skip
        os.replace(part, self.checkpoint)

    @property
    def share(self) -> float:
        """Share of training that is over, up to 1."""
        return min(1.0, max(self.seconds / (60 * self.config.minutes), self.step / self.config.steps))

    def set_rate(self) -> None:
        """Set the learning rate by the share of training that is over: a short rise, then half a cosine."""
        rate = self.config.rate * min(1.0, (self.step + 1) / 50) * (0.5 + 0.5 * math.cos(math.pi * self.share)) + 1e-6
        for group in self.optimizer.param_groups:
            group["lr"] = rate


def _work(
    rank: int,
    files: list[Path],
    held_out: list[Path],
    output: Path,
    config: TrainConfig,
    begin: Path | None,
    meeting: str | None,
) -> None:
    torch.set_num_threads(1)
    if meeting is not None:
        distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=config.processes)
    run = _Run(output, config, begin)
    # Every process holds its own share of the pairs.
    own = files[rank :: config.processes]
    pairs = PairStore(own, config.device)
    others = PairStore(held_out, config.device) if rank == 0 else None
    generator = torch.Generator().manual_seed(config.seed + 1000 * rank + run.step)
    order, losses = torch.empty(0, dtype=torch.int64), []
    count = config.batch // config.processes
    while True:
        begun = time.monotonic()
        if len(order) < count:
            pairs = PairStore(own, config.device)
            order = torch.randperm(len(pairs), generator=generator)
        rows, order = order[:count], order[count:]
        losses.append(_step(run, pairs.batch(rows, torch.rand(count, generator=generator) < 0.5)))
        run.step += 1
        run.seconds = _agreed(run.seconds + time.monotonic() - begun, meeting)
        over = run.share >= 1
        if rank == 0 and (over or run.step % config.every == 0):
            _report(run, pairs if others is None else others, sum(losses) / len(losses), output)
            losses = []
        if over:
            break
    if meeting is not None:
        distributed.destroy_process_group()


def _step(run: _Run, batch: PairBatch) -> float:
    """Make one step of the optimizer; processes take the mean of their gradients."""
    batch = batch.to(run.config.device)
    loss = assignment_loss(run.net(batch.source, batch.target), batch)
    run.optimizer.zero_grad()
    loss.backward()
    parameters = [parameter for parameter in run.net.parameters() if parameter.grad is not None]
    if distributed.is_initialized():
        flat = nn.utils.parameters_to_vector([p.grad for p in parameters if p.grad is not None])
        distributed.all_reduce(flat)
        nn.utils.vector_to_parameters(flat / run.config.processes, [p.grad for p in parameters if p.grad is not None])
    nn.utils.clip_grad_norm_(parameters, 1.0)
    run.set_rate()
    run.optimizer.step()
    return float(loss.detach())


def _agreed(seconds: float, meeting: str | None) -> float:
    """Return the time of the slowest process."""
    if meeting is None:
        return seconds
    value = torch.tensor(seconds, dtype=torch.float64)
    distributed.all_reduce(value, distributed.ReduceOp.MAX)
    return float(value)


def _report(run: _Run, pairs: PairStore, loss: float, output: Path) -> None:
    """Validate, print and keep a row of the curve, and write the checkpoint."""
    found, names = validate(run.net, pairs, run.config.device), kind_names()
    scores = found.pop(-1)
    row: dict[str, Any] = {"step": run.step, "seconds": round(run.seconds), "train_loss": loss, **asdict(scores)}
    row["right_by_kind"] = {names[kind]: round(of.right, 3) for kind, of in found.items()}
    with (output / "curve.jsonl").open("a", encoding="utf-8") as curve:
        curve.write(json.dumps(row) + "\n")
    typer.echo(
        f"step {run.step}  {run.seconds / 60:.1f} min  loss {loss:.3f}  held out: loss {scores.loss:.3f}, "
        f"right {scores.right:.3f}, hidden found {scores.recall:.2f}, rightly {scores.precision:.2f}"
    )
    run.save(scores.right)
