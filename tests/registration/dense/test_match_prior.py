import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.registration.dense.coarse_fit import fit_coarsely
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.stages import Reporter

TOKENS, SEEN = 20, 24


@pytest.fixture
def prior():
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(size, 3, generator=generator, dtype=torch.float64) for size in (60, 90))
    logits = 3 * torch.randn(TOKENS + 1, SEEN + 1, generator=generator, dtype=torch.float64)
    return MatchPrior.of_logits(logits, source, target)


def test_samples_at_tokens_have_what_those_have(prior):
    torch.testing.assert_close(prior.source.sum(1), torch.ones(60, dtype=torch.float64))
    assert int((prior.source > 0).sum(1).max()) == int((prior.target > 0).sum(1).max()) == 3
    assert torch.equal(prior.source[:TOKENS].argmax(1), torch.arange(TOKENS))


def test_tables_share_out_what_is_visible(prior):
    one, other = prior.tables(60, 90)
    torch.testing.assert_close(one.sum(1), prior.visible)
    torch.testing.assert_close(other.sum(0), prior.target_visible)
    assert 0 < float(prior.visible.min()) <= float(prior.visible.max()) <= 1


def test_support_is_that_of_the_tokens_about(prior):
    own, other, tokens = prior.source, prior.target, prior.by_source
    index = torch.randint(len(other), (7, 5), generator=torch.Generator().manual_seed(1))
    found = prior.logarithm(index, 0.1)
    for row in range(7):
        for column in range(5):
            chance = sum(
                own[row, a] * tokens[a, b] * other[index[row, column], b]
                for a in range(tokens.shape[0])
                for b in range(tokens.shape[1])
            )
            assert float(found[row, column]) == pytest.approx(float(((3 * chance + 0.1) / 1.1).log()))


def test_tokens_that_repeat_samples_count_together():
    generator = torch.Generator().manual_seed(2)
    source, target = (torch.rand(size, 3, generator=generator, dtype=torch.float64) for size in (4, 5))
    alone = torch.randn(5, 6, generator=generator, dtype=torch.float64)
    # Twice each token, with half its odds: hidden tokens stay as likely.
    rows, columns = torch.tensor([0, 1, 2, 3] * 2 + [4]), torch.tensor([0, 1, 2, 3, 4] * 2 + [5])
    doubled = alone[rows][:, columns] - torch.log(torch.tensor(2.0))
    doubled[:, -1], doubled[-1] = alone[rows, -1], alone[-1, columns]
    doubled[-1, -1] = alone[-1, -1]
    one, two = (MatchPrior.of_logits(logits, source, target) for logits in (alone, doubled))
    torch.testing.assert_close(two.by_source, one.by_source)
    torch.testing.assert_close(two.by_target, one.by_target)
    assert two.source.shape == (4, 4)


def test_doubt_bounds_what_impossible_matches_lose(prior):
    index = torch.arange(90).expand(60, -1)
    assert float(prior.logarithm(index, 0.1).min()) >= torch.tensor(0.1 / 1.1).log()
    assert float(prior.logarithm(index, 1e9).abs().max()) < 1e-8


def test_a_graph_is_taken_far_by_the_matches():
    pair = walking_figure(6, scanner=DepthScanner(num_points=1500)).pair(0, 2)
    problem = describe(pair.source, pair.target, ScanAlignConfig(num_samples=400))
    records = []
    transforms = fit_coarsely(problem, Reporter("matches", 2.0, records.append))
    truth = problem.unit.normalize(pair.truth[problem.samples])
    before, after = ((problem.graph(motions) - truth).norm(dim=-1) for motions in (problem.graph.rest(), transforms))
    assert float(after.mean()) < 0.5 * float(before.mean())
    assert [record.step for record in records] == list(range(14))
    assert {record.stage for record in records} == {"match"}
    assert records[0].width == pytest.approx(0.7)
