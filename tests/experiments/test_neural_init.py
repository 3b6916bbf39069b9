"""The example of neural poses: what each variant of training starts from and sees, its data, and its summary."""

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

SCENE = CloudScene(train=16, held_out=4, num_points=100)
SHORT = NeuralTrial(width=8, steps=4, batch=8, report_every=2)


@pytest.fixture(scope="module")
def hand():
    return tr.Hand().requires_grad_(False)


@pytest.fixture(scope="module")
def loaded(hand):
    return data.load_clouds(hand, SCENE)


@pytest.fixture
def clouds(loaded):
    return loaded[0]


@pytest.fixture
def prior(hand, clouds):
    return prior_of(Setup(hand, clouds, 8, False, torch.Generator().manual_seed(0)))


def final(hand, clouds, held_out, config):
    return list(train(hand, clouds, held_out, config))[-1][1]


def test_clouds_are_as_the_scene_says_and_poses_are_found_without_a_start(hand, clouds):
    assert clouds.points.shape == (16, 100, 3)
    share = clouds.truth[:, 6:] / hand.upper[6:]
    assert share.min() >= 0
    assert share.max() <= 0.5 + 1e-6
    # A tenth of the points are outliers; the others lie within the noise of the surface.
    off = hand.distance(clouds.points, clouds.truth).abs() > 0.006
    assert off.sum(-1).max() <= 10
    assert off.sum() > 50
    assert apart(hand, clouds.found, clouds.truth).mean(-1).median() < 0.01
    assert ((clouds.confidence >= 0) & (clouds.confidence <= 1)).all()
    alone = errors_mm(hand, lambda some: some.found, clouds)
    torch.testing.assert_close(errors_mm(hand, PoseRefiner(hand, 8), clouds), alone, atol=1e-2, rtol=0)


def test_kept_clouds_are_made_once(hand, tmp_path, monkeypatch):
    scene = replace(SCENE, train=2, held_out=1, folder=str(tmp_path / "clouds"))
    first, other = data.load_clouds(hand, scene)

    def never(*arguments):
        raise AssertionError("made again")

    monkeypatch.setattr(data, "draw_poses", never)
    again, held_out = data.load_clouds(hand, scene)
    assert torch.equal(first.points, again.points)
    assert torch.equal(other.found, held_out.found)
    with pytest.raises(AssertionError, match="made again"):
        data.load_clouds(hand, replace(scene, noise_mm=2.0))


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_learn_and_only_some_see_the_truth(hand, loaded, variant):
    clouds, config = loaded[0], replace(SHORT, variant=variant)
    wrong = replace(clouds, truth=clouds.truth + 0.3)
    same = torch.equal(final(hand, *loaded, config), final(hand, wrong, loaded[1], config))
    assert same == (variant in NO_TRUTH)
    if variant not in NO_TRUTH:
        hidden = clouds.without_truth()
        model, loss = VARIANTS[variant](Setup(hand, hidden, 8, False, torch.Generator().manual_seed(0)))
        with pytest.raises(ValueError, match="learns from true poses"):
            loss(model(hidden), hidden, 0.5)
    config = NeuralTrial(variant=variant, width=16, steps=100, batch=16, averaging=0.0, report_every=100)
    (_, before), (_, after) = train(hand, clouds, clouds, config)
    assert after.mean() < (0.95 if variant == "refiner" else 0.8) * before.mean()


def test_a_seed_decides_everything_and_leaves_the_global_generator_alone(hand, loaded):
    torch.manual_seed(3)
    before = torch.get_rng_state()
    one = final(hand, *loaded, SHORT)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(4)
    assert torch.equal(one, final(hand, *loaded, SHORT))
    assert not torch.equal(one, final(hand, *loaded, replace(SHORT, seed=1)))


def test_an_initialized_head_gives_the_mean_and_the_spread_of_what_was_found(hand, clouds, prior):
    model = PoseRegressor(hand, 32, True)
    model.start_from_(prior)
    with torch.no_grad():
        # Features of zero mean and unit variance.
        spread = model.net.last(torch.randn(500, 128))[:, 9:].std(0) / (clouds.found[:, 6:].std(0) + 1e-3)
        model.net.last.weight.zero_()
        poses = model(clouds)
    assert spread.median() == pytest.approx(1.0, abs=0.2)
    expected = prior.mean + torch.nn.functional.pad(clouds.centers, (0, 24))
    assert apart(hand, poses, expected).max() < 1e-5


def test_a_refiner_thinks_in_the_frame_of_the_palm(hand, clouds):
    """Clouds and poses that are moved together give the same steps, moved."""
    torch.manual_seed(0)
    model = PoseRefiner(hand, 8)
    torch.nn.init.normal_(model.net.last.weight, std=0.2)
    shift, half = torch.tensor([0.1, 0.2, -0.3]), torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    # Half a turn about z takes quaternion (w, v) to (-v_z, (-v_y, v_x, w)).
    vector = clouds.found[:, 3:6]
    angle = vector.norm(dim=-1, keepdim=True)
    w, (x, y, z) = (angle / 2).cos(), ((angle / 2).sin() * vector / angle).split(1, dim=-1)
    turned = torch.cat([-y, x, w], dim=-1)
    turned = 2 * torch.atan2(turned.norm(dim=-1, keepdim=True), -z) * torch.nn.functional.normalize(turned, dim=-1)
    found = torch.cat([clouds.found[:, :3] @ half + shift, turned, clouds.found[:, 6:]], dim=-1)
    moved = replace(clouds, points=clouds.points @ half + shift, found=found)
    with torch.no_grad():
        one, other = hand.keypoints(model(clouds)), hand.keypoints(model(moved))
    assert (one - hand.keypoints(clouds.found)).norm(dim=-1).max() > 1e-2
    torch.testing.assert_close(other, one @ half + shift, atol=1e-4, rtol=0)


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
    identity = trial_id("neural_init", config), "neural_init", tr.__version__, config, seed, "done"
    return TrialRecord(*identity, {"tips_mm": errors[-1]}, {}, {"steps": [0.0, 50.0, 100.0], "tips_mm": errors})


def test_the_summary_compares_with_the_mean_of_the_baseline(tmp_path, capsys):
    for bar, steps in ((20.0, 75.0), (50.0, 0.0), (5.0, None)):
        assert summary.steps_to(record("head", 0, [40.0, 30.0, 10.0]), bar) == steps
    store, other = Store(tmp_path), Store(tmp_path / "other")
    rows = {
        "scratch": ([80.0, 40.0, 22.0], [80.0, 40.0, 18.0]),
        "head": ([40.0, 20.0, 10.0], [40.0, 30.0, 10.0]),
        "em": ([40.0, 38.0, 36.0], [40.0, 38.0, 30.0]),
    }
    store.prepare()
    for variant, curves in rows.items():
        for seed, errors in enumerate(curves):
            store.write(record(variant, seed, errors))
    lines = {line.split()[0]: line for line in summary.main([str(tmp_path)])}
    assert "20.00 (18.00 to 22.00)   1.00" in lines["scratch"]
    # 20 mm, which the baseline ends with, after 50 and 75 of 100 steps.
    assert "10.00 (10.00 to 10.00)   0.50" in lines["head"]
    assert lines["head"].endswith("0.62 (0.50 to 0.75)")
    assert lines["em"].endswith("not by 2 of 2")
    assert lines["em"] in capsys.readouterr().out
    other.prepare()
    other.write(record("head", 0, [40.0, 20.0, 16.0]))
    assert "16.00 (16.00 to 16.00)   0.80" in summary.main([str(other.root), "--baseline", str(tmp_path)])[1]
    with pytest.raises(SystemExit):
        summary.main([str(other.root)])
    assert "holds no finished trial of the variant scratch" in capsys.readouterr().err
