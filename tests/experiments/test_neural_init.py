"""The example of neural poses: what each variant of training starts from and sees, its data, and its summary."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.neural_init import data, summary
from experiments.neural_init.train import NO_TRUTH, VARIANTS, Setup, train
from experiments.plan import trial_id
from experiments.records import TrialRecord
from experiments.schema import CloudScene, NeuralTrial
from experiments.store import Store
from experiments.structure import plain

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


def final(hand, clouds, held_out, config):
    return list(train(hand, clouds, held_out, config))[-1][1]


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
