"""The demonstration: a hand moves before a pair of cameras, is found and tracked, on synthetic data."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchreg.datasets.hand import HandCloud
from torchreg.datasets.sequences import hand_sequence
from torchreg.shapes.hand import Hand
from torchreg.tracking.results import DemoResult, FrameResult, TrackResult
from torchreg.tracking.tracker import TrackConfig, Tracker

DEMO_FPS = 20.0


def run_demo(
    num_frames: int = 40,
    seed: int = 0,
    *,
    config: TrackConfig | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> DemoResult:
    """Return a hand tracked through a synthetic sequence, with the ground truth.

    A pair of cameras sees the palm of a hand that bends its fingers and sways: up to 600 points on the hand per frame,
    with 1.5 mm of noise in depth, and 257 outliers on a forearm, a wall and in the air. The tracker is given no initial
    pose.

    Args:
        num_frames: number of frames, 20 per second.
        seed: of the motion and the measurements.
        config: of the tracker.
        on_frame: called with (frames done, all frames) after each frame.

    Returns:
        The track with the truth. An interruption by the keyboard after the first frame ends the sequence: the result
        then holds the frames done.
    """
    hand = Hand()
    clouds = hand_sequence("bending_palm", num_frames, DEMO_FPS, shape=hand, seed=seed)
    inliers: list[Tensor] = []

    def keep_inliers(points: Tensor, result: FrameResult) -> None:
        inliers.append(result.inliers)
        if on_frame is not None:
            on_frame(len(inliers), len(clouds))

    times = [frame / DEMO_FPS for frame in range(len(clouds))]
    track = Tracker(hand, config=config).run([cloud.points for cloud in clouds], keep_inliers, times=times)
    return _with_truth(hand, track, clouds[: len(track.poses)], inliers, seed)


def _with_truth(
    hand: Hand, track: TrackResult, clouds: Sequence[HandCloud], inliers: Sequence[Tensor], seed: int
) -> DemoResult:
    tips = [4 * finger + 4 for finger in range(len(hand.fingertip_parts))]
    true_keypoints = torch.stack([cloud.keypoints for cloud in clouds])
    return DemoResult(
        track=track,
        truths=torch.stack([cloud.pose for cloud in clouds]),
        clouds=tuple(cloud.points for cloud in clouds),
        inliers=tuple(inliers[: len(clouds)]),
        tip_errors=(track.keypoints - true_keypoints)[:, tips].norm(dim=-1),
        tips_seen=torch.stack([cloud.seen_parts[list(hand.fingertip_parts)] for cloud in clouds]),
        seed=seed,
    )
