"""The main job on made-up data: a hand moves before a camera and is aligned frame after frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

import torchreg.pipelines.storage  # noqa: F401  so that what is returned can be saved
from torchreg._checks import check_shape
from torchreg.datasets.hand import HandCloud, hand_motion, make_hand_cloud, surface_skin
from torchreg.models.hand import Hand
from torchreg.models.skin import LinearBlendSkin, sample_skin
from torchreg.pipelines.align import AlignConfig, align
from torchreg.results import AlignResult, DemoResult

DEMO_FPS = 20.0
_NUM_POINTS, _OUTLIER_RATIO = 600, 0.2
# A flat hand, fingers up, palm to a camera that looks along +z with -y up.
_FACING = (math.pi / 2, 0.0, 0.0)
# Fewer points than this on the last phalanx, and the fingertip was not measured but guessed.
_MIN_TIP_POINTS = 8


def run_demo(
    num_frames: int = 40,
    seed: int = 0,
    *,
    config: AlignConfig | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> DemoResult:
    """Return a made-up hand sequence, aligned frame after frame, beside the truth.

    A camera sees one side of a hand that bends its fingers and sways, 600 points per frame with 1.5 mm of noise, and
    outliers, 20 % of all points. The first frame starts from a flat hand, palm to the camera, in the middle of the
    cloud; every other from the pose before.

    Args:
        num_frames: number of frames, 20 per second.
        seed: of motion and measurements.
        config: of the alignments.
        on_frame: is told (frames done, all frames) after each.

    Returns:
        a `DemoResult`. An interruption by the keyboard after the first frame ends the sequence: the result then holds
        the frames that were done.

    Raises:
        InputError: if ``num_frames`` is not a positive integer.

    Differentiable: no.

    Cost: about as long as `align` takes for each frame, and a second to begin with.
    """
    hand = Hand()
    truths = hand_motion(hand, "bend", num_frames, DEMO_FPS, seed=seed)
    surface, skin = surface_skin(hand), _model_points(hand, config)
    generator = torch.Generator().manual_seed(seed)
    clouds: list[HandCloud] = []
    results: list[AlignResult] = []
    seconds: list[float] = []
    pose: Tensor | None = None
    try:
        for truth in truths:
            cloud = make_hand_cloud(
                hand, truth, num_points=_NUM_POINTS, outlier_ratio=_OUTLIER_RATIO, camera=torch.zeros(3), skin=surface,
                generator=generator,
            )  # fmt: skip
            pose = moved_to_mean(skin, _flat_pose(hand), cloud.points) if pose is None else pose
            started = time.perf_counter()
            result = align(hand, cloud.points, pose, model_points=skin, config=config)
            seconds.append(time.perf_counter() - started)
            clouds.append(cloud)
            results.append(result)
            pose = result.pose if result.statuses[0].usable else pose
            if on_frame is not None:
                on_frame(len(results), len(truths))
    except KeyboardInterrupt:
        if not results:
            raise
    return _beside_truth(hand, clouds[: len(results)], results, seconds[: len(results)], seed)


def moved_to_mean(skin: LinearBlendSkin, pose: Tensor, cloud: Tensor) -> Tensor:
    """Return the pose moved so that the mean of the posed skin lies at the mean of a cloud; the turn stays.

    Args:
        skin: of the shape.
        pose: (num_dofs,).
        cloud: (M, 3) finite points, metres.

    Returns:
        (num_dofs,).

    Raises:
        InputError: if a size is wrong.
    """
    check_shape(cloud, "cloud", ("M", 3))
    with torch.no_grad():
        offset = cloud.to(pose).mean(0) - skin(skin.shape.check_pose(pose)).mean(0)
    return torch.cat([pose[:3] + offset, pose[3:]])


def _model_points(hand: Hand, config: AlignConfig | None) -> LinearBlendSkin:
    config = config or AlignConfig()
    return sample_skin(hand, config.num_model_points, sharpness=config.sharpness)


def _flat_pose(hand: Hand) -> Tensor:
    pose = hand.rest_pose()
    pose[3:6] = pose.new_tensor(_FACING)
    return pose


def _beside_truth(
    hand: Hand, clouds: list[HandCloud], results: list[AlignResult], seconds: list[float], seed: int
) -> DemoResult:
    truths = torch.stack([cloud.pose for cloud in clouds])
    tips = [4 * finger + 4 for finger in range(len(hand.fingertip_parts))]
    with torch.no_grad():
        places = torch.stack([result.keypoints for result in results])[:, tips]
        errors = (places - hand.keypoints(truths)[:, tips]).norm(dim=-1)
    labels = torch.stack([cloud.part_labels for cloud in clouds])
    counts = torch.stack([(labels == part).sum(-1) for part in hand.fingertip_parts], dim=-1)
    return DemoResult(
        poses=torch.stack([result.pose for result in results]),
        truths=truths,
        clouds=torch.stack([cloud.points for cloud in clouds]),
        inliers=torch.stack([result.inliers for result in results]),
        tip_errors=errors,
        tips_seen=counts >= _MIN_TIP_POINTS,
        seconds=torch.tensor(seconds, dtype=torch.float64),
        status=tuple(result.statuses[0] for result in results),
        seed=seed,
    )
