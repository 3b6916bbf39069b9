"""A new kind of evidence is one class and one entry of a problem's factors."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

import torchreg as tr
from tests.alignment.made import problem_of
from torchreg.alignment.fit.objectives import Factor
from torchreg.alignment.fit.surface_fit import fit_surface
from torchreg.solvers.levenberg_marquardt import Linearization


@dataclass(frozen=True, eq=False)
class ContactPoint(Factor):
    """A point of the shape, a skin of one, that is known to touch a place (B, 3), metres."""

    skin: tr.LinearBlendSkin
    place: Tensor
    std: float = 0.001

    def rows(self, index):
        return replace(self, place=self.place[index])

    def linearized(self, pose, sigma, noise):
        points, motion = self.skin.jacobian(pose, chart="tangent")
        residual, jacobian = (points - self.place[:, None])[:, 0] / self.std, motion[:, 0] / self.std
        gradient = (jacobian.mT @ residual[..., None])[..., 0]
        return Linearization(0.5 * residual.square().sum(-1), gradient, jacobian.mT @ jacobian)

    def cost(self, pose, sigma, noise):
        return self.score(pose, 0.0)

    def score(self, pose, width):
        return 0.5 * ((self.skin(pose)[..., 0, :] - self.place) / self.std).square().sum(-1)


def test_a_contact_point_places_a_link_that_no_data_show(links, links_skin):
    """Data of the first link alone say nothing of the others; the point of the last one that touches something does."""
    bend = torch.tensor([0.0] * 6 + [0.4, -0.3]).to(links.rest)
    pose, start = (links.retract(links.rest_pose(), share * bend)[None] for share in (1.0, 0.5))
    last = links_skin.points[:, 2].argmax()[None]
    tip = tr.LinearBlendSkin(links, links_skin.points[last], links_skin.weights[last], links_skin.reference_pose)
    alone = problem_of(links_skin, links_skin(pose)[:, links_skin.weights.argmax(-1) == 0], start)
    touching = replace(alone, factors=(ContactPoint(tip, tip(pose)[:, 0]),))
    far, near = (float((tip(fit_surface(each, start, steps=4).pose) - tip(pose)).norm()) for each in (alone, touching))
    assert far > 0.02
    assert near < 0.001
