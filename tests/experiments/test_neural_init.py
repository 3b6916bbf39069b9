"""The example of neural poses: what each way of training starts from and sees, its data, and what is told of it."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.errors import ConfigError
from experiments.neural_init import data, summary
from experiments.neural_init.model import PoseRefiner, PoseRegressor
from experiments.neural_init.train import NO_TRUTH, VARIANTS, Setup, apart, errors_mm, prior_of, train
from experiments.plan import trial_id
from experiments.records import TrialRecord
from experiments.schema import CloudScene, NeuralTrial
from experiments.store import Store
from experiments.structure import build, plain
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp

SCENE = CloudScene(train=16, held_out=4, num_points=100)
SHORT = NeuralTrial(width=8, steps=4, batch=8, report_every=2)


@pytest.fixture(scope="module")
def hand():
    return tr.Hand().requires_grad_(False)


@pytest.fixture(scope="module")
def clouds(hand):
    return data.load_clouds(hand, SCENE)[0]


@pytest.fixture(scope="module")
def held_out(hand):
    return data.load_clouds(hand, SCENE)[1]


def setup_of(hand, clouds):
    return Setup(hand, clouds, 8, False, torch.Generator().manual_seed(0))


def final(hand, clouds, held_out, config):
    return list(train(hand, clouds, held_out, config))[-1][1]


def test_clouds_are_what_the_scene_says(hand, clouds, held_out):
    assert clouds.points.shape == (16, 100, 3)
    assert len(held_out) == 4
    turns = so3_exp(clouds.truth[:, 3:6]) @ so3_exp(torch.tensor(data.FACING)).mT
    angles = torch.acos((turns.diagonal(dim1=-2, dim2=-1).sum(-1) / 2 - 0.5).clamp(-1, 1))
    assert angles.max() <= math.radians(45.0) + 1e-3
    share = clouds.truth[:, 6:] / hand.upper[6:]
    assert share.min() >= 0
    assert share.max() <= 0.5 + 1e-6
    # A tenth of the points are outliers; the others lie within the noise of the surface.
    off = hand.distance(clouds.points, clouds.truth).abs() > 0.006
    assert off.sum(-1).max() <= 10
    assert off.sum() > 50


def test_poses_are_found_without_a_start(hand, clouds):
    assert apart(hand, clouds.found, clouds.truth).mean(-1).median() < 0.01
    assert ((clouds.confidence >= 0) & (clouds.confidence <= 1)).all()


def test_kept_clouds_are_made_once(hand, tmp_path, monkeypatch):
    scene = replace(SCENE, train=2, held_out=1, folder=str(tmp_path / "clouds"))
    first, other = data.load_clouds(hand, scene)

    def never(*arguments):
        raise AssertionError("made again")

    monkeypatch.setattr(data, "draw_poses", never)
    again, held_out = data.load_clouds(hand, scene)
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.truth, again.truth)
    assert torch.equal(other.found, held_out.found)
    with pytest.raises(AssertionError, match="made again"):
        data.load_clouds(hand, replace(scene, noise_mm=2.0))


@pytest.mark.parametrize("variant", VARIANTS)
def test_only_some_variants_see_the_truth(hand, clouds, held_out, variant):
    config = replace(SHORT, variant=variant)
    wrong = replace(clouds, truth=clouds.truth + 0.3)
    same = torch.equal(final(hand, clouds, held_out, config), final(hand, wrong, held_out, config))
    assert same == (variant in NO_TRUTH)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_truth_can_be_missing_where_it_is_not_needed(hand, clouds, variant):
    hidden = clouds.without_truth()
    model, loss = VARIANTS[variant](setup_of(hand, hidden))
    if variant in NO_TRUTH:
        assert loss(model(hidden), hidden, 0.5).isfinite()
    else:
        with pytest.raises(ValueError, match="learns from true poses"):
            loss(model(hidden), hidden, 0.5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_learns(hand, clouds, variant):
    """On the few clouds it is trained with, measured with them."""
    config = NeuralTrial(variant=variant, width=16, steps=100, batch=16, averaging=0.0, report_every=100)
    (_, before), (_, after) = train(hand, clouds, clouds, config)
    bar = 0.95 if variant == "refiner" else 0.8
    assert after.mean() < bar * before.mean()


def test_a_seed_decides_everything_and_leaves_the_global_generator_alone(hand, clouds, held_out):
    torch.manual_seed(3)
    before = torch.get_rng_state()
    one = final(hand, clouds, held_out, SHORT)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(4)
    assert torch.equal(one, final(hand, clouds, held_out, SHORT))
    assert not torch.equal(one, final(hand, clouds, held_out, replace(SHORT, seed=1)))


def test_an_initialized_head_gives_the_mean_of_what_was_found(hand, clouds):
    prior = prior_of(setup_of(hand, clouds))
    model = PoseRegressor(hand, 8)
    model.start_from_(prior)
    with torch.no_grad():
        model.net.last.weight.zero_()
        poses = model(clouds)
    expected = prior.mean + torch.nn.functional.pad(clouds.centers, (0, 24))
    assert apart(hand, poses, expected).max() < 1e-5


def test_normalized_features_give_the_spread_of_the_prior_too(hand, clouds):
    """Features of zero mean and unit variance are what `init_head_` assumes; ReLUs alone give smaller ones."""
    prior, spreads = prior_of(setup_of(hand, clouds)), []
    for normalized in (False, True):
        torch.manual_seed(0)
        model = PoseRegressor(hand, 32, normalized)
        model.start_from_(prior)
        with torch.no_grad():
            outputs = (
                model.net.last(torch.randn(500, 128)) if normalized else model.net(clouds.points, torch.zeros(16, 0))
            )
        spreads.append(outputs[:, 9:].std(0) / (clouds.found[:, 6:].std(0) + 1e-3))
    assert spreads[1].median() == pytest.approx(1.0, abs=0.2)
    assert spreads[0].median() < 0.3


def test_a_refiner_starts_from_what_was_found(hand, clouds):
    alone = errors_mm(hand, lambda some: some.found, clouds)
    torch.testing.assert_close(errors_mm(hand, PoseRefiner(hand, 8), clouds), alone, atol=1e-2, rtol=0)


def test_a_refiner_thinks_in_the_frame_of_the_palm(hand, clouds):
    """Clouds and poses that are moved together give the same steps, moved."""
    torch.manual_seed(0)
    model = PoseRefiner(hand, 8)
    torch.nn.init.normal_(model.net.last.weight, std=0.2)
    vector, shift = torch.tensor([0.3, -0.9, 0.5]), torch.tensor([0.1, 0.2, -0.3])
    turn = so3_exp(vector)
    found = torch.cat([
        clouds.found[:, :3] @ turn.mT + shift,
        compose_rotation_vectors(vector.expand(len(clouds), 3), clouds.found[:, 3:6]),
        clouds.found[:, 6:],
    ], dim=-1)  # fmt: skip
    moved = replace(clouds, points=clouds.points @ turn.mT + shift, found=found)
    with torch.no_grad():
        here, there = hand.keypoints(model(clouds)), hand.keypoints(model(moved))
    assert (here - hand.keypoints(clouds.found)).norm(dim=-1).max() > 1e-2
    torch.testing.assert_close(there, here @ turn.mT + shift, atol=1e-4, rtol=0)


def test_a_network_in_half_precision_may_stand_around_the_initializer(hand, clouds):
    """Its poses come in bfloat16 under autocast; the layer between computes in float32, and hands gradients back."""
    some = clouds.rows(slice(2))
    model = PoseRegressor(hand, 8)
    model.start_from_(prior_of(setup_of(hand, clouds)))
    layer = tr.PoseInitializer(hand, tr.PoseInitializerConfig(fit_steps=3, newton_steps=1))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        start = model(some)
        raw = model.net(some.points - some.centers.unsqueeze(1), some.points.new_zeros(2, 0))
        found = layer(some.points, start=start)
    assert raw.dtype == torch.bfloat16
    assert found.pose.dtype == found.keypoints.dtype == torch.float32
    exact = layer(some.points, start=start.detach().requires_grad_())
    assert apart(hand, found.pose, exact.pose).max() < 1e-5
    found.keypoints.square().sum().backward()
    assert model.net.last.weight.grad.dtype == torch.float32
    assert model.net.last.weight.grad.isfinite().all()
    assert model.net.last.weight.grad.abs().max() > 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"variant": "magic"}, "variant must be one of scratch, head"),
        ({"scene": {"held_out": 0}}, "held_out must be at least 1"),
        ({"scene": {"bend": 1.5}}, "bend must be from 0 to 1"),
        ({"scene": {"outlier_ratio": 1.0}}, "outlier_ratio must be"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"averaging": 1.0}, "averaging must be at least 0 and below 1"),
        ({"steps": 0}, "steps must be at least 1"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        build(NeuralTrial, settings, "trial")


def record(variant, seed, errors):
    config = plain(NeuralTrial(variant=variant, seed=seed, steps=100, report_every=50))
    return TrialRecord(
        trial_id("neural_init", config), "neural_init", tr.__version__, config, seed, "done",
        {"tips_mm": errors[-1]}, {}, {"steps": [0.0, 50.0, 100.0], "tips_mm": errors},
    )  # fmt: skip


def test_steps_are_counted_until_the_baseline_s_error():
    assert summary.steps_to(record("head", 0, [40.0, 30.0, 10.0]), 20.0) == 75.0
    assert summary.steps_to(record("head", 0, [40.0, 30.0, 10.0]), 50.0) == 0.0
    assert summary.steps_to(record("head", 0, [40.0, 30.0, 10.0]), 5.0) is None


def test_the_summary_compares_with_the_mean_of_the_baseline(tmp_path, capsys):
    store = Store(tmp_path)
    store.prepare()
    for one in (
        record("scratch", 0, [80.0, 40.0, 22.0]), record("scratch", 1, [80.0, 40.0, 18.0]),
        record("head", 0, [40.0, 20.0, 10.0]), record("head", 1, [40.0, 30.0, 10.0]),
        record("em", 0, [40.0, 38.0, 36.0]), record("em", 1, [40.0, 38.0, 30.0]),
    ):  # fmt: skip
        store.write(one)
    lines = {line.split()[0]: line for line in summary.main([str(tmp_path)])}
    assert "20.00 (18.00 to 22.00)   1.00" in lines["scratch"]
    # 20 mm, which the baseline ends with, after 50 and 75 of 100 steps.
    assert "10.00 (10.00 to 10.00)   0.50" in lines["head"]
    assert lines["head"].endswith("0.62 (0.50 to 0.75)")
    assert lines["em"].endswith("not by 2 of 2")
    assert lines["em"] in capsys.readouterr().out
    other = Store(tmp_path / "other")
    other.prepare()
    other.write(record("head", 0, [40.0, 20.0, 16.0]))
    told = summary.main([str(other.root), "--baseline", str(tmp_path)])
    assert "16.00 (16.00 to 16.00)   0.80" in told[1]
    with pytest.raises(SystemExit):
        summary.main([str(other.root)])
    assert "holds no finished trial of the variant scratch" in capsys.readouterr().err
