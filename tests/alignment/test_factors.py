"""A kind of evidence that the library does not have counts in fits, rankings and covariances once it is in the list."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tests.alignment.made import problem_of
from torchreg.alignment.fit.annealed_em import anneal
from torchreg.alignment.fit.factors import Factor
from torchreg.alignment.fit.problem import alignment_cost
from torchreg.alignment.fit.sigma_schedule import SigmaSchedule
from torchreg.alignment.fit.surface_fit import fit_surface
from torchreg.solvers.levenberg_marquardt import Linearization


@dataclass(frozen=True)
class KnownContact(Factor):
    """A point of the skin that touches a known place (3,), with a standard deviation in metres."""

    skin: object
    point: int
    place: Tensor
    std: float

    def rows(self, index):
        return self

    def _offset(self, pose):
        return (self.skin(pose)[..., self.point, :] - self.place) / self.std

    def score(self, pose, width):
        return 0.5 * self._offset(pose).square().sum(-1)

    def cost(self, pose, sigma, noise):
        return self.score(pose, 0.0)

    def linearized(self, pose, sigma, noise):
        points, motion = self.skin.jacobian(pose, chart="tangent")
        offset, jacobian = (points[:, self.point] - self.place) / self.std, motion[:, self.point] / self.std
        gradient = (jacobian * offset.unsqueeze(-1)).sum(-2)
        return Linearization(0.5 * offset.square().sum(-1), gradient, jacobian.mT @ jacobian)


def test_a_new_kind_of_evidence_is_one_entry_of_a_list(links_skin, links_pose):
    with torch.no_grad():
        posed = links_skin(links_pose)
    end = int(links_skin.weights[:, -1].argmax())
    seen = posed[links_skin.weights[:, -1] < 0.05]  # nothing of the last part
    start = links_pose.clone()
    start[-1] += 0.4
    plain = problem_of(links_skin, seen[None], start[None], prior_std=None)
    contact = KnownContact(links_skin, end, posed[end] - plain.origin[0], 1e-3)
    known = replace(plain, factors=(contact,))
    local = start[None].clone()
    local[:, :3] -= plain.origin

    def off(problem):
        schedule = SigmaSchedule.geometric(0.05, 0.02, 3)
        rough = anneal(problem, local, schedule, em_steps=5, m_steps=2).pose
        pose = fit_surface(problem, rough, steps=5).pose
        return float((links_skin(pose)[0, end] - contact.place).norm())

    assert off(known) < 3e-3 < 0.3 * off(plain)
    truth = links_pose[None].clone()
    truth[:, :3] -= plain.origin
    assert float(alignment_cost(known, local) - alignment_cost(plain, local)) > 1.0
    assert float(alignment_cost(known, truth) - alignment_cost(plain, truth)) < 1e-3
