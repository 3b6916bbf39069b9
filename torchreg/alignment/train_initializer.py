"""Training of the network that proposes poses of a shape, on made-up clouds of it."""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.alignment.search.pose_proposer import PoseProposer, ProposerSize, RawPoses, posed_points
from torchreg.alignment.shape.person_proposer import PersonProposer, RawPeople, is_body
from torchreg.datasets.cloud_batches import CloudBatch, random_clouds, random_poses
from torchreg.datasets.people_batches import PeopleBatch, PeopleBatches
from torchreg.errors import FormatError
from torchreg.io.limits import local_path
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin, sample_skin


@dataclass(frozen=True)
class _Training:
    """Numbers of the training; lengths are shares of the shape's size."""

    surface_points: int = 3000  # of which clouds are drawn
    compared: int = 64  # points by which poses are compared
    width: tuple[float, float] = (0.15, 0.02)  # scale of the errors' distribution, from the first step to the last
    people_width: tuple[float, float] = (0.015, 0.01)  # the same of people: headings are apart from the start
    surface_weight: float = 1.0  # of what tokens tell, beside the poses
    surface_width: float = 0.05  # error of a token at which its loss turns from squares to absolute values
    warm_up: int = 200  # steps until the full rate
    decay: float = 0.01  # of weights
    validation: int = 256  # clouds
    right: float = 0.05  # a pose with a smaller mean error counts as near


_TRAINING = _Training()


@dataclass(frozen=True)
class TrainInitializerConfig:
    """Settings of `train_initializer`.

    Args:
        minutes: of training, in which the rate falls to nothing; what was trained before counts.
        steps: most of them; training ends with whatever comes first.
        batch: clouds per step.
        rate: largest learning rate.
        every: steps between two validations and checkpoints.
        seed: of the network and of all clouds.
    """

    minutes: float = 30.0
    steps: int = 1_000_000
    batch: int = 64
    rate: float = 1e-3
    every: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "every"):
            check_count(getattr(self, name), name, 1)
        for name in ("minutes", "rate"):
            check_positive(getattr(self, name), name)


@dataclass(frozen=True)
class TrainingRow:
    """How a training is at a validation.

    Args:
        step: number of steps made.
        seconds: of training.
        loss: mean of the steps since the last validation.
        error: of the most probable pose, mean distance of points as a share of the size, mean over clouds.
        best: of the best of all proposed poses.
        near: share of the clouds whose best proposed pose is within 5 %.
    """

    step: int
    seconds: float
    loss: float
    error: float
    best: float
    near: float


def train_initializer(
    shape: ArticulatedShape,
    output: str | os.PathLike[str],
    config: TrainInitializerConfig | None = None,
    *,
    size: ProposerSize | None = None,
    progress: Callable[[TrainingRow], None] | None = None,
) -> PoseProposer | PersonProposer:
    """Train a network that proposes poses of a shape, on made-up clouds; go on where an earlier run ended.

    Clouds are one-sided or whole, noisy, with outliers and holes, in any rotation. The loss is the negative logarithm
    of a mixture, over the proposed poses, of distributions of the mean distance of the shape's points; beside it, every
    token tells where on the shape it lies. Everything runs on the shape's device.

    Args:
        shape: in metres; its base can move.
        output: file of the weights, ``.safetensors``; beside it a checkpoint and the curve are kept.
        config: see `TrainInitializerConfig`.
        size: of the network, see `ProposerSize`.
        progress: is told of every validation.

    Returns:
        The network, as `PoseProposer.load` gives it.

    Raises:
        InputError: if the shape's base cannot move.
        FormatError: if the checkpoint beside the output is of another shape or network.

    Cost: 30 minutes on two cores by default; deterministic by its seed but for when it ends.
    """
    config = config or TrainInitializerConfig()
    path = local_path(output)
    run = _Run(copy.deepcopy(shape).requires_grad_(False), path, config, size)
    while run.share < 1:
        begun = time.monotonic()
        loss = run.advance()
        run.seconds += time.monotonic() - begun
        if run.step % config.every == 0 or run.share >= 1:
            row = run.validated(loss)
            run.save(row)
            if progress is not None:
                progress(row)
    run.net.save(path, {**asdict(config), "minutes": run.seconds / 60, "steps": run.step})
    return PoseProposer.load(path, shape) if isinstance(run.net, PoseProposer) else PersonProposer.load(path)


class PoseLesson:
    """Poses of any shape: clouds whose index tells of places (N, 3) at `rest`, and how wrong proposals are."""

    width = _TRAINING.width

    def __init__(self, shape: ArticulatedShape, size: ProposerSize | None) -> None:
        self.shape, self.net = shape, PoseProposer(shape, size).to(shape.rest.device)
        self.skin = sample_skin(shape, _TRAINING.surface_points)
        self.compared = sample_skin(shape, _TRAINING.compared)
        self.rest = self.skin.points

    def clouds(self, count: int, generator: torch.Generator) -> CloudBatch:
        """Return clouds, half of them windows of scenes."""
        poses = random_poses(self.shape, count, generator)
        return random_clouds(self.skin, self.net.shape_size, poses, self.net.size.points, generator, in_scenes=True)

    def errors(self, raw: RawPoses, batch: CloudBatch) -> Tensor:
        """Return the errors (B, K) of the shape's points."""
        return pose_errors(raw, batch, self.compared, self.net.shape_size)


class PersonLesson:
    """People of a body with coefficients, of all sizes."""

    width = _TRAINING.people_width

    def __init__(self, body: ArticulatedShape, size: ProposerSize | None) -> None:
        self.net = PersonProposer.of(body, size)
        self.people = PeopleBatches(body, self.net.marks)
        self.rest = self.people.rest

    def clouds(self, count: int, generator: torch.Generator) -> PeopleBatch:
        """Return clouds, bare and clothed."""
        return self.people.clouds(count, self.net.size.points, generator, self.net.shape_size)

    def errors(self, raw: RawPeople, batch: PeopleBatch) -> Tensor:
        """Return the errors (B, K) of the marks, as shares of each person's own size."""
        return (raw.marks - batch.marks.unsqueeze(1)).norm(dim=-1).mean(-1) / batch.sizes.unsqueeze(1)


class _Run:
    """The state of a training: network, optimizer, and how far it is."""

    def __init__(
        self, shape: ArticulatedShape, path: Path, config: TrainInitializerConfig, size: ProposerSize | None
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.checkpoint, self.curve = config, path.with_suffix(".pt"), path.with_suffix(".jsonl")
        device = shape.rest.device
        self.lesson = PersonLesson(shape, size) if is_body(shape) else PoseLesson(shape, size)
        self.net = self.lesson.net
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=config.rate, weight_decay=_TRAINING.decay)
        self.generator = torch.Generator(device).manual_seed(config.seed)
        self.step, self.seconds, self.total = 0, 0.0, torch.zeros((), device=device)
        if self.checkpoint.exists():
            self._resume()
        with torch.no_grad():
            generator = torch.Generator(device).manual_seed(config.seed + 1)
            self.validation: Any = self.lesson.clouds(_TRAINING.validation, generator)

    @property
    def share(self) -> float:
        """Share of training that is over, up to 1."""
        return min(1.0, max(self.seconds / (60 * self.config.minutes), self.step / self.config.steps))

    def advance(self) -> Tensor:
        """Make a step of the optimizer and return the sum of losses since the last validation."""
        with torch.no_grad():
            batch: Any = self.lesson.clouds(self.config.batch, self.generator)
        device = batch.points.device.type
        with torch.autocast(device, dtype=torch.bfloat16, enabled=device == "cuda"):
            raw = self.net(batch.points, batch.mask)
        errors = self.lesson.errors(raw, batch)
        loss = proposal_loss(raw, batch, errors, self.lesson.rest / self.net.shape_size, self._width())
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate()
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        self.total = self.total + loss.detach()
        return self.total

    @torch.no_grad()
    def validated(self, total: Tensor) -> TrainingRow:
        """Return how the network does on clouds that it is not trained on."""
        self.net.eval()
        raw = self.net(self.validation.points, self.validation.mask)
        errors = self.lesson.errors(raw, self.validation)
        self.net.train()
        shown = self.validation.is_shown
        first = errors.gather(1, raw.logits.argmax(1, keepdim=True))[shown].mean()
        best = errors.amin(1)[shown]
        steps = (self.step - 1) % self.config.every + 1
        self.total = torch.zeros_like(total)
        near = (best < _TRAINING.right).double().mean()
        return TrainingRow(
            self.step, round(self.seconds, 1), float(total) / steps, float(first), float(best.mean()), float(near)
        )

    def save(self, row: TrainingRow) -> None:
        """Write the checkpoint, and a row of the curve."""
        state = {
            "net": self.net.state_dict(), "optimizer": self.optimizer.state_dict(), "step": self.step,
            "seconds": self.seconds, "generator": self.generator.get_state(),
        }  # fmt: skip
        part = self.checkpoint.with_suffix(".part")
        torch.save(state, part)
        os.replace(part, self.checkpoint)
        with self.curve.open("a", encoding="utf-8") as curve:
            curve.write(json.dumps(asdict(row)) + "\n")

    def _resume(self) -> None:
        state = torch.load(self.checkpoint, weights_only=True, map_location=self.net.queries.device)
        try:
            self.net.load_state_dict(state["net"])
            self.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, ValueError) as error:
            raise FormatError(
                f"{self.checkpoint}: is of another shape or network; move it away or name another output ({error})"
            ) from error
        self.step, self.seconds = state["step"], state["seconds"]
        self.generator.set_state(state["generator"].cpu())

    def _rate(self) -> float:
        """Return the learning rate: a short rise, then half a cosine."""
        rise = min(1.0, (self.step + 1) / _TRAINING.warm_up)
        return self.config.rate * rise * (0.5 + 0.5 * math.cos(math.pi * self.share)) + 1e-7

    def _width(self) -> float:
        """Return the scale of the errors' distribution, which narrows in the first half of the training."""
        first, last = map(math.log, self.lesson.width)
        return math.exp(first + (last - first) * min(1.0, 2 * self.share))


def pose_errors(raw: RawPoses, batch: CloudBatch, compared: LinearBlendSkin, size: float) -> Tensor:
    """Return the mean distances (B, K) of a shape's points from where they are, as a share of its size."""
    found, truth = posed_points(raw, compared), compared(batch.poses).unsqueeze(1)
    return (found - truth).norm(dim=-1).mean(-1) / size


def proposal_loss(raw: RawPoses | RawPeople, batch: CloudBatch, errors: Tensor, rest: Tensor, width: float) -> Tensor:
    """Return the loss () of proposals with errors (B, K), see `train_initializer`; ``width`` scales the errors.

    Lengths, those of places (N, 3) at rest too, are shares of the size.
    """
    likely = torch.logsumexp(raw.logits.log_softmax(-1) - errors / width, dim=-1)
    # In units of the error: the gradient does not grow as the distribution narrows.
    poses = -width * (likely * batch.is_shown).sum() / batch.is_shown.sum().clamp_min(1)
    index = batch.index.gather(1, raw.token_index)
    known = batch.mask.gather(1, raw.token_index)
    inlier = known & (index >= 0)
    truth = rest[index.clamp_min(0)]
    error = torch.nn.functional.smooth_l1_loss(
        raw.surface[..., :3], truth, reduction="none", beta=_TRAINING.surface_width
    ).sum(-1)
    outlier = torch.nn.functional.binary_cross_entropy_with_logits(
        raw.surface[..., 3], (index < 0).to(error), reduction="none"
    )
    tokens = (error * inlier).sum() / inlier.sum().clamp_min(1) + 0.1 * (outlier * known).sum() / known.sum().clamp_min(
        1
    )
    return poses + _TRAINING.surface_weight * tokens
