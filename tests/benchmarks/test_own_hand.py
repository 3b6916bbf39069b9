import math

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose, surface_skin
from torchreg.geometry.rotation import so3_exp


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("own_hand") as module:
        yield module


def test_smoke_prints_every_row(bench, capsys):
    rows = bench.main(["--smoke", "--case", "exact"])
    printed = capsys.readouterr().out
    assert [row.method for row in rows] == ["align", "least squares"] * 2 + ["bound"]
    assert printed.count("mean <= 1.5 mm: ") == 2
    assert all(bool(torch.isfinite(row.errors).all()) for row in rows)


def test_starts_are_as_far_off_as_stated(bench):
    hand, generator = tr.Hand(), torch.Generator().manual_seed(1)
    middle = hand.rest_pose()
    middle[6:] = (0.5 * (hand.lower + hand.upper))[6:]
    middle[3:6] = torch.tensor([0.3, -0.5, 0.2])
    starts = bench.start_of(hand, middle, generator)
    moved = torch.rad2deg((starts["joints"] - middle).abs())
    limited = torch.rad2deg((hand.upper - hand.lower)[6:] / 2).clamp_max(20)
    assert torch.allclose(moved[6:], limited, atol=1e-3)
    assert torch.allclose(starts["joints"][:6], middle[:6], atol=1e-6)
    turned = starts["joints+base"]
    relative = so3_exp(turned[3:6]) @ so3_exp(middle[3:6]).T
    angle = math.degrees(math.acos((float(relative.trace()) - 1) / 2))
    assert angle == pytest.approx(20, abs=0.01)
    assert float((turned[:3] - middle[:3]).norm()) == pytest.approx(0.02, abs=1e-6)


def test_bound_agrees_with_repeated_least_squares(bench):
    """On noise alone, without outliers, estimates scatter around the truth as the bound predicts."""
    hand, generator = tr.Hand(), torch.Generator().manual_seed(5)
    pose = random_hand_pose(hand, generator)
    skin, spread = surface_skin(hand, spacing=0.005), []
    for _ in range(8):
        cloud = make_hand_cloud(hand, pose, skin=skin, outlier_ratio=0.0, camera=torch.zeros(3), generator=generator)
        trial = bench.make_trial(hand, cloud, generator)
        trial.starts["joints"] = pose
        found = bench.least_squares(hand, trial, "joints")
        spread.append(bench.seen_errors(hand, [found], [trial]).square().mean().sqrt())
    bound = bench.bound_draws(hand, trial, generator).square().mean().sqrt()
    assert 0.5 < float(torch.stack(spread).mean() / bound) < 1.5


def test_other_hand_is_five_percent_off_everywhere(bench):
    hand, plain = bench.other_hand(torch.Generator().manual_seed(2)), tr.Hand()
    with torch.no_grad():
        ratio = torch.cat([hand.bone_lengths / plain.bone_lengths, hand.radii[1:, 0] / plain.radii[1:, 0]])
    off = torch.maximum(ratio, 1 / ratio)
    assert torch.allclose(off, torch.full_like(off, 1.05), atol=1e-4)
    assert ratio.min() < 1 < ratio.max()


def test_verdict_follows_the_mean(bench):
    good = bench.Row("exact", "joints", "align", torch.tensor([0.001, 0.0019]), 0.1, 1.5)
    bad = bench.Row("exact", "joints", "align", torch.tensor([0.001, 0.0021]), 0.1, 1.5)
    lines = bench.render([good, bad]).splitlines()
    assert lines[1].endswith("mean <= 1.5 mm: pass")
    assert lines[2].endswith("mean <= 1.5 mm: FAIL")
