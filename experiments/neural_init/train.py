"""Five ways to train the same network on the same clouds, and the errors of its poses over the steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import torchreg as tr

from ..neural_init.data import Clouds
from ..neural_init.model import PoseRefiner, PoseRegressor
from ..schema import NeuralTrial

TIPS = [4, 8, 12, 16, 20]
# Poses less sure than this say nothing of what hands do.
TRUSTED = 0.6
# Keypoints are compared in this unit: metres.
LOSS_UNIT = 0.1
# The EM loss: model points and data drawn of each cloud, its width from the first step on down to the last, metres,
# and how much the prior counts, which holds fingers that no data show.
EM_POINTS, EM_SIGMA, EM_ANNEALED, EM_PRIOR = 200, (0.03, 0.008), 0.7, 0.01
_WARM_UP, _BATCH = 50, 128


@dataclass(frozen=True)
class Setup:
    """The data and settings of a variant.

    Args:
        hand: whose poses.
        clouds: to learn from.
        width: of the network.
        normalized: see `PointNet`.
        generator: of draws.
    """

    hand: tr.Hand
    clouds: Clouds
    width: int
    normalized: bool
    generator: torch.Generator


# The loss () of poses (B, num_dofs) predicted for clouds, at a share of the training from 0 to 1.
Loss = Callable[[Tensor, Clouds, float], Tensor]


def scratch(setup: Setup) -> tuple[nn.Module, Loss]:
    """(a) The truth is known; the network knows nothing."""
    return PoseRegressor(setup.hand, setup.width, setup.normalized), to_truth(setup)


def head(setup: Setup) -> tuple[nn.Module, Loss]:
    """(b) The truth is known; the last layer starts from the poses that torchreg found."""
    model = PoseRegressor(setup.hand, setup.width, setup.normalized)
    model.start_from_(prior_of(setup))
    return model, to_truth(setup)


def labels(setup: Setup) -> tuple[nn.Module, Loss]:
    """(c) No truth: the poses that torchreg found are the labels, weighted by their confidence."""
    mean = setup.clouds.confidence.mean()

    def loss(poses: Tensor, clouds: Clouds, share: float) -> Tensor:
        return (clouds.confidence / mean * apart(setup.hand, poses, clouds.found).mean(-1)).mean() / LOSS_UNIT

    return PoseRegressor(setup.hand, setup.width, setup.normalized), loss


def refiner(setup: Setup) -> tuple[nn.Module, Loss]:
    """(d) The truth is known; the network refines the poses that torchreg found."""
    return PoseRefiner(setup.hand, setup.width, setup.normalized), to_truth(setup)


def em(setup: Setup) -> tuple[nn.Module, Loss]:
    """(e) No labels at all: the posed hand should explain the cloud, and poses be likely."""
    prior, skin = prior_of(setup), tr.sample_skin(setup.hand, EM_POINTS)
    model = PoseRegressor(setup.hand, setup.width, setup.normalized)
    model.start_from_(prior)

    def loss(poses: Tensor, clouds: Clouds, share: float) -> Tensor:
        wide, narrow = EM_SIGMA
        sigma = wide * (narrow / wide) ** min(1.0, share / EM_ANNEALED)
        sample = torch.randint(clouds.points.shape[1], (EM_POINTS,), generator=setup.generator)
        unexplained = tr.EMLoss(sigma, reduction="mean")(skin(poses), clouds.points[:, sample])
        return (unexplained - EM_PRIOR * prior.log_prob(centered(poses, clouds))).mean()

    return model, loss


VARIANTS: dict[str, Callable[[Setup], tuple[nn.Module, Loss]]] = {
    "scratch": scratch, "head": head, "labels": labels, "refiner": refiner, "em": em,
}  # fmt: skip
NO_TRUTH = ("labels", "em")


def to_truth(setup: Setup) -> Loss:
    """Return the mean distance of keypoints from the true ones."""

    def loss(poses: Tensor, clouds: Clouds, share: float) -> Tensor:
        if clouds.truth is None:
            raise ValueError("this variant learns from true poses, and the clouds have none")
        return apart(setup.hand, poses, clouds.truth).mean() / LOSS_UNIT

    return loss


def apart(hand: tr.Hand, poses: Tensor, others: Tensor) -> Tensor:
    """Return distances (B, K) between keypoints, metres."""
    return (hand.keypoints(poses) - hand.keypoints(others)).norm(dim=-1)


def centered(poses: Tensor, clouds: Clouds) -> Tensor:
    """Return poses (B, num_dofs) relative to the middle of their clouds."""
    return torch.cat([poses[:, :3] - clouds.centers, poses[:, 3:]], dim=-1)


def prior_of(setup: Setup) -> tr.PosePrior:
    """Return the prior of the poses that torchreg found with confidence; of all, if those are too few."""
    found = centered(setup.clouds.found, setup.clouds)
    sure = setup.clouds.confidence >= TRUSTED
    return tr.PosePrior.fit(setup.hand, found[sure] if int(sure.sum()) > setup.hand.num_dofs else found)


def errors_mm(hand: tr.Hand, predict: Callable[[Clouds], Tensor], clouds: Clouds) -> Tensor:
    """Return distances (B, K), mm, of the keypoints of predicted poses from the true ones."""
    if clouds.truth is None:
        raise ValueError("clouds that are measured with must have true poses")
    rows = torch.arange(len(clouds)).split(_BATCH)
    with torch.no_grad():
        poses = torch.cat([predict(clouds.rows(part)) for part in rows])
        return 1e3 * apart(hand, poses, clouds.truth)


def train(hand: tr.Hand, clouds: Clouds, held_out: Clouds, config: NeuralTrial) -> Iterator[tuple[int, Tensor]]:
    """Yield after every ``config.report_every`` steps their number and the errors (B, K) on the clouds held out, mm.

    Errors are those of the weights' moving average, which needs no schedule of the learning rate to settle, so that
    the curves can be read at any step.
    """
    known = clouds.without_truth() if config.variant in NO_TRUTH else clouds
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # torch.nn draws its first weights from the global generator
        model, loss = VARIANTS[config.variant](Setup(hand, known, config.width, config.normalized, generator))
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(config.averaging))
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=0.0)
    warm_up = torch.optim.lr_scheduler.LinearLR(optimizer, 1 / _WARM_UP, 1.0, _WARM_UP)
    yield 0, errors_mm(hand, model, held_out)
    for step, rows in enumerate(_batches(len(known), config, generator), start=1):
        batch = known.rows(rows)
        value = loss(model(batch), batch, step / config.steps)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        warm_up.step()
        average.update_parameters(model)
        if step % config.report_every == 0 or step == config.steps:
            yield step, errors_mm(hand, average, held_out)


def _batches(count: int, config: NeuralTrial, generator: torch.Generator) -> Iterator[Tensor]:
    """Yield rows for each step; every cloud once before any comes again."""
    remaining = config.steps
    while remaining > 0:
        for rows in torch.randperm(count, generator=generator).split(config.batch)[:remaining]:
            remaining -= 1
            yield rows
