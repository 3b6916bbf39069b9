"""Logistic models that are fitted to cases."""

import pytest
import torch

from torchreg.solvers.calibration import Logistic, fit_logistic


@pytest.mark.parametrize("weighted", [False, True])
def test_the_model_is_that_by_which_the_cases_were_drawn(weighted):
    generator = torch.Generator().manual_seed(0)
    evidence = torch.rand(4000, 3, generator=generator)
    truth = Logistic(2.0, (4.0, 0.0, 1.0))
    right = torch.rand(4000, generator=generator) < truth.probability(evidence)
    weights = None
    if weighted:
        # Cases without weight do not count, whatever they say.
        weights = torch.cat((torch.ones(4000), torch.zeros(4000)))
        evidence, right = evidence.repeat(2, 1), torch.cat((right, ~right))
    found = fit_logistic(evidence, right, weights)
    assert found.bias == pytest.approx(truth.bias, abs=0.4)
    assert found.weights == pytest.approx(truth.weights, abs=0.6)
    torch.testing.assert_close(found.log_odds(evidence).sigmoid(), found.probability(evidence))


def test_few_cases_move_a_model_little_and_many_all_the_way():
    before, truth = Logistic(1.0, (1.0,)), Logistic(3.0, (5.0,))
    evidence = torch.rand(4000, 1, generator=torch.Generator().manual_seed(0))
    right = torch.rand(4000, generator=torch.Generator().manual_seed(1)) < truth.probability(evidence)
    found = [fit_logistic(evidence[:count], right[:count], before=before) for count in (1, 40, 400, 4000)]
    assert found[0].weights == pytest.approx(before.weights, abs=1.0)  # half the deviation of the prior
    assert found[0].weights < found[1].weights < found[2].weights < found[3].weights
    assert found[3].weights == pytest.approx(truth.weights, abs=0.6)


def test_a_held_weight_stays_and_the_others_are_as_good_as_they_can_be_with_it():
    before, truth = Logistic(0.0, (1.5, 1.0)), Logistic(2.0, (3.0, 4.0))
    evidence = torch.rand(4000, 2, generator=torch.Generator().manual_seed(0))
    right = torch.rand(4000, generator=torch.Generator().manual_seed(1)) < truth.probability(evidence)
    found = fit_logistic(evidence, right, before=before, held=[0])
    assert found.weights[0] == 1.5
    gradient = (found.probability(evidence) - right.float()) @ torch.stack([torch.ones(4000), -evidence[:, 1]], dim=1)
    assert float(gradient.abs().max()) / 4000 < 2e-3


def test_evidence_that_speaks_for_what_it_should_speak_against_has_no_weight():
    evidence = torch.rand(500, 1, generator=torch.Generator().manual_seed(0))
    assert fit_logistic(evidence, evidence[:, 0] > 0.5).weights == (pytest.approx(0, abs=0.02),)
