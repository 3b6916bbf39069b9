"""A prior skeleton forced on made-up creatures: its names and graph, wherever it lies, also where frames lack limbs."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import STAR, arms_skeleton, nearest_arms, shuffled, similarity, without_arm
from torchreg.datasets.solids import RoundCone, mesh_of
from torchreg.geometry.rotation import so3_exp
from torchreg.spines.skeleton.clearance import Inside

FORK = "((()())()())"
FRAMES = 5
# Tips of a body with four limbs, two of which part at a fork on the x axis.
ENDS = torch.tensor([[1.0, 0.45, 0.0], [1.0, -0.45, 0.1], [-0.8, 0.7, 0.0], [-0.9, -0.6, 0.2]], dtype=torch.float64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the skeletons of the starfish are kept, for they do not depend on a prior."""
    return tmp_path_factory.mktemp("skeletons")


@pytest.fixture(scope="module")
def named(starfish, folder):
    return tr.extract_spine(starfish.meshes, prior=arms_skeleton(starfish, 0), workers=1, progress=folder)


def test_tips_are_called_as_those_of_the_prior(named, starfish):
    arm, distance = nearest_arms(named, starfish)
    assert torch.equal(arm, torch.arange(5).expand(FRAMES, 5))
    assert float(distance.max()) < 0.05
    assert set(named.topologies) == {STAR}
    assert bool(named.own.all())


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 40.0), (2, 1e-3)])
def test_the_order_of_limbs_is_that_of_names_and_position_and_size_do_not_matter(named, starfish, folder, seed, scale):
    order = shuffled(5, seed)
    prior = arms_skeleton(starfish, 0, order).transformed(similarity(seed, scale))
    again = tr.extract_spine(starfish.meshes, prior=prior, workers=1, progress=folder)
    torch.testing.assert_close(again.curves, named.curves[:, order], atol=1e-5, rtol=0)
    assert torch.equal(again.found, named.found[:, order])
    assert again.reference == named.reference


def test_a_spine_is_a_prior_for_other_frames(named, starfish, folder):
    order = torch.tensor([3, 1, 4, 0, 2])
    spine = tr.extract_spine(starfish.meshes, prior=arms_skeleton(starfish, 4, order), workers=1, progress=folder)
    later = tr.extract_spine(starfish.meshes[1:3], prior=spine, workers=1)
    assert torch.equal(later.graph, spine.graph)
    assert torch.equal(nearest_arms(later, replace(starfish, tips=starfish.tips[1:3]))[0], order.expand(2, 5))
    # A spine that a prior from its own sequence names has the same names again.
    again = tr.extract_spine(starfish.meshes, prior=spine, workers=1, progress=folder)
    torch.testing.assert_close(again.curves, spine.curves, atol=1e-5, rtol=0)


@pytest.mark.parametrize("lacking", [{1: 1, 2: 1, 3: 1}, {frame: frame for frame in range(FRAMES)}])
def test_limbs_that_frames_lack_are_kept_with_their_names(starfish, tmp_path, lacking):
    meshes = list(starfish.meshes)
    for frame, arm in lacking.items():
        meshes[frame] = without_arm(starfish, frame, arm)
    assert tr.extract_spine(meshes, workers=1, progress=tmp_path).num_tips == 4
    spine = tr.extract_spine(meshes, prior=arms_skeleton(starfish, 0), workers=1, progress=tmp_path)
    shown = torch.ones(FRAMES, 5, dtype=torch.bool)
    shown[list(lacking), list(lacking.values())] = False
    assert torch.equal(spine.found, shown)
    assert torch.equal(spine.own, shown)
    assert set(spine.topologies) == {STAR}
    arm, distance = nearest_arms(spine, starfish)
    assert torch.equal(arm[shown], torch.arange(5).expand(FRAMES, 5)[shown])
    assert float(distance[shown].max()) < 0.05
    assert bool(spine.curves.isfinite().all())
    assert any(row.startswith(f"frame 2: tips {lacking[2]} not found") for row in spine.warnings)


def test_a_limb_that_no_frame_shows_is_the_priors_inside_the_body(starfish):
    meshes = [without_arm(starfish, frame, 1) for frame in range(2)]
    spine = tr.extract_spine(meshes, prior=arms_skeleton(starfish, 0), workers=1)
    assert spine.num_tips == 5
    assert not bool(spine.own[:, 1].any() or spine.found[:, 1].any())
    assert bool(spine.own[:, [0, 2, 3, 4]].all())
    assert spine.status is tr.Status.WITH_WARNINGS
    inside = Inside(tr.TriangleMesh(starfish.meshes[0].vertices.double(), starfish.meshes[0].faces))
    assert bool(inside(spine.curves[0, 1].double()).float().mean() > 0.9)
    torch.testing.assert_close(spine.curves[:, 1, -1], spine.junctions[:, 0])


def forked(fork, frame):
    """A body whose first two limbs part at a distance from the middle, turned a little more in every frame."""
    middle, branch = [0.0, 0, 0], [fork, 0.0, 0.0]
    bones = [(branch if row < 2 else middle, ENDS[row].tolist()) for row in range(4)] + [(middle, branch)]
    surface = mesh_of([RoundCone(tuple(a), tuple(b), 0.1, 0.07) for a, b in bones], 0.04, 0.03)
    turn = so3_exp(frame * torch.tensor([0.05, 0.1, 0.15], dtype=torch.float64))
    return tr.TriangleMesh(surface.vertices @ turn.mT, surface.faces), ENDS @ turn.mT


def straight_prior(fork, order=(0, 1, 2, 3)):
    """The bones of `forked`, with its tips in an order; with the fork in the middle a star."""
    middle = torch.tensor([[0.0, 0.0, 0.0], [fork, 0.0, 0.0]], dtype=torch.float64)
    edges = [[k, 5 if fork and tip < 2 else 4] for k, tip in enumerate(order)] + ([[4, 5]] if fork else [])
    nodes = torch.cat((ENDS[list(order)], middle[: 2 if fork else 1]))
    return tr.Skeleton(nodes, torch.tensor(edges), torch.full((len(nodes),), 0.1).double())


@pytest.mark.parametrize(
    ("forks", "fork", "topology"),
    [
        ((0.0, 0.5, 0.5, 0.0), 0.0, "(()()()())"),  # the frames disagree on the tree
        ((0.0, 0.5, 0.5, 0.0), 0.5, FORK),
        ((0.5, 0.5), 0.0, "(()()()())"),  # a tree that no frame has
    ],
)
def test_the_prior_decides_which_tree_it_is(forks, fork, topology, tmp_path):
    meshes, ends = zip(*(forked(value, frame) for frame, value in enumerate(forks)), strict=True)
    order = [2, 0, 3, 1]
    prior = straight_prior(fork, order).transformed(similarity(5, 3.0))
    spine = tr.extract_spine(meshes, prior=prior, workers=1, progress=tmp_path)
    assert set(spine.topologies) == {topology}
    assert float((spine.tips - torch.stack(ends)[:, order]).norm(dim=-1).max()) < 0.08
    assert spine.junctions.shape[1] == (2 if fork else 1)
    assert bool(spine.own.all()) or len(forks) == 4


def test_superfluous_tips_are_left_out_where_asked_for(starfish, folder):
    four = arms_skeleton(starfish, 0, [4, 0, 2, 3])
    words = r"prior must have the limbs of the data: it has 4 tips, most frames show 5; .* or num_tips=4"
    with pytest.raises(tr.errors.InputError, match=words):
        tr.extract_spine(starfish.meshes, prior=four, workers=1, progress=folder)
    config = tr.SpineConfig(num_tips=4)
    spine = tr.extract_spine(starfish.meshes, prior=four, config=config, workers=1, progress=folder)
    assert torch.equal(nearest_arms(spine, starfish)[0], torch.tensor([4, 0, 2, 3]).expand(FRAMES, 4))
    assert all("1 superfluous tip(s) left out" in row for row in spine.warnings)


POINT = tr.Skeleton(torch.zeros(1, 3), torch.zeros(0, 2).long(), torch.ones(1))
FLAT = tr.Skeleton(torch.zeros(2, 3), torch.tensor([[0, 1]]), torch.ones(2))


@pytest.mark.parametrize(
    ("prior", "config", "error", "words"),
    [
        ("bones", None, "InputTypeError", "prior must be a Skeleton or a SpineSequence, got str"),
        (POINT, None, "InputError", r"prior must have two tips or more, apart from each other, got 1 tip\(s\)"),
        (FLAT, None, "InputError", r"prior must have two tips or more, apart from each other, got 2 tip\(s\)"),
        (straight_prior(0.0), tr.SpineConfig(num_tips=3), "InputError", "num_tips must be that of the prior, 4, got 3"),
        (straight_prior(0.0), tr.SpineConfig.paper(), "InputError", r"prior cannot be used by SpineConfig.paper\(\)"),
    ],
)
def test_what_is_no_prior_is_refused(starfish, prior, config, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        tr.extract_spine(starfish.meshes, prior=prior, config=config)
