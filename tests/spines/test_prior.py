"""A prior skeleton forced on made-up creatures: its names and graph, wherever it lies, also where frames lack limbs."""

from dataclasses import replace

import pytest
import torch

from torchreg.datasets.creatures import OCTOPUS, STARFISH, creature_sequence
from torchreg.datasets.solids import RoundCone, mesh_of
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import Skeleton, build_skeleton
from torchreg.result import Status
from torchreg.spines.extract_spine import SpineConfig, extract_spine
from torchreg.spines.names.tip_tracking import track_tips
from torchreg.spines.skeleton.clearance import Inside

STAR, FORK = "(()()()()())", "((()())()())"
FRAMES = 5
# Tips of a body with four limbs, two of which part at a fork on the x axis.
ENDS = torch.tensor([[1.0, 0.45, 0.0], [1.0, -0.45, 0.1], [-0.8, 0.7, 0.0], [-0.9, -0.6, 0.2]], dtype=torch.float64)


def axes_skeleton(sequence, frame, order=None):
    """The true axes of a creature's arms in one frame, as a skeleton whose tips are the arms in an order."""
    curves = sequence.curves[frame].double().flip(1)[torch.arange(len(sequence.radii)) if order is None else order]
    radii, frames = sequence.radii[0].double().flip(0), torch.eye(3, dtype=torch.float64).expand(curves.shape[1], 3, 3)
    return build_skeleton([(curve, radii, frames) for curve in curves], [(k, 99) for k in range(len(curves))])


def anywhere(seed, scale):
    """A rigid motion with scale, (4, 4)."""
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = scale * so3_exp(3 * torch.randn(3, generator=generator, dtype=torch.float64))
    matrix[:3, 3] = 10 * scale * torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix


def without_arm(sequence, frame, arm):
    """The surface of a frame with an arm cut off, which leaves a hole."""
    mesh, axis = sequence.meshes[frame], sequence.curves[frame, arm]
    outer = (torch.cdist(mesh.vertices, axis[12:]).amin(1) < 0.3) & (
        (mesh.vertices - axis[12]) @ (axis[20] - axis[0]) > 0
    )
    return TriangleMesh(mesh.vertices, mesh.faces[~outer[mesh.faces].any(-1)])


def nearest_arms(spine, sequence):
    """The arm (T, K) whose true tip is nearest to each tip, and the distance."""
    distance, arm = torch.cdist(spine.tips.double(), sequence.tips.double()).min(-1)
    return arm, distance


@pytest.fixture(scope="module")
def starfish():
    return creature_sequence(STARFISH, FRAMES, resolution=40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the skeletons of the starfish are kept, for they do not depend on a prior."""
    return tmp_path_factory.mktemp("skeletons")


@pytest.fixture(scope="module")
def named(starfish, folder):
    return extract_spine(starfish.meshes, prior=axes_skeleton(starfish, 0), workers=1, progress=folder)


def test_tips_are_called_as_those_of_the_prior(named, starfish):
    arm, distance = nearest_arms(named, starfish)
    assert torch.equal(arm, torch.arange(5).expand(FRAMES, 5))
    assert float(distance.max()) < 0.05
    assert set(named.topologies) == {STAR}
    assert bool(named.own.all())


@pytest.mark.parametrize("seed", [0, 1])
def test_an_order_of_limbs_becomes_the_order_of_names(named, starfish, folder, seed):
    order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
    again = extract_spine(starfish.meshes, prior=axes_skeleton(starfish, 0, order), workers=1, progress=folder)
    torch.testing.assert_close(again.curves, named.curves[:, order], atol=1e-5, rtol=0)
    assert torch.equal(again.found, named.found[:, order])


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 40.0), (2, 1e-3)])
def test_where_the_prior_lies_and_how_large_it_is_does_not_matter(named, starfish, folder, seed, scale):
    moved = axes_skeleton(starfish, 0).transformed(anywhere(seed, scale))
    again = extract_spine(starfish.meshes, prior=moved, workers=1, progress=folder)
    torch.testing.assert_close(again.curves, named.curves, atol=1e-5, rtol=0)
    assert again.reference == named.reference


def test_a_spine_is_a_prior_for_other_frames(named, starfish, folder):
    order = torch.tensor([3, 1, 4, 0, 2])
    spine = extract_spine(starfish.meshes, prior=axes_skeleton(starfish, 4, order), workers=1, progress=folder)
    later = extract_spine(starfish.meshes[1:3], prior=spine, workers=1)
    assert torch.equal(later.graph, spine.graph)
    truth = replace(starfish, tips=starfish.tips[1:3])
    assert torch.equal(nearest_arms(later, truth)[0], order.expand(2, 5))
    # A spine that a prior from its own sequence names has the same names again.
    again = extract_spine(starfish.meshes, prior=spine, workers=1, progress=folder)
    torch.testing.assert_close(again.curves, spine.curves, atol=1e-5, rtol=0)


def test_a_limb_that_most_frames_lack_is_kept(starfish, tmp_path):
    meshes = [starfish.meshes[0], *(without_arm(starfish, k, 1) for k in (1, 2, 3)), starfish.meshes[4]]
    plain = extract_spine(meshes, workers=1, progress=tmp_path)
    assert plain.num_tips == 4
    spine = extract_spine(meshes, prior=axes_skeleton(starfish, 0), workers=1, progress=tmp_path)
    assert spine.num_tips == 5
    assert set(spine.topologies) == {STAR}
    assert spine.found[:, 1].tolist() == [True, False, False, False, True]
    assert bool(spine.found[:, [0, 2, 3, 4]].all())
    arm, distance = nearest_arms(spine, starfish)
    assert torch.equal(arm[spine.found], torch.arange(5).expand(FRAMES, 5)[spine.found])
    assert float(distance[spine.found].max()) < 0.05
    assert any(row.startswith("frame 2: tips 1 not found") for row in spine.warnings)


def test_names_stay_where_every_frame_lacks_another_limb(starfish, tmp_path):
    meshes = [without_arm(starfish, frame, frame) for frame in range(FRAMES)]
    plain = extract_spine(meshes, workers=1, progress=tmp_path)
    assert len({tuple(row) for row in nearest_arms(plain, starfish)[0].tolist()}) > 1
    spine = extract_spine(meshes, prior=axes_skeleton(starfish, 0), workers=1, progress=tmp_path)
    assert torch.equal(spine.found, ~torch.eye(FRAMES, dtype=torch.bool))
    assert torch.equal(spine.own, spine.found)
    arm, _ = nearest_arms(spine, starfish)
    assert torch.equal(arm[spine.found], torch.arange(5).expand(FRAMES, 5)[spine.found])
    assert bool(spine.curves.isfinite().all())


def test_a_limb_that_no_frame_shows_is_the_priors_inside_the_body(starfish):
    meshes = [without_arm(starfish, frame, 1) for frame in range(2)]
    spine = extract_spine(meshes, prior=axes_skeleton(starfish, 0), workers=1)
    assert spine.num_tips == 5
    assert not bool(spine.own[:, 1].any() or spine.found[:, 1].any())
    assert bool(spine.own[:, [0, 2, 3, 4]].all())
    assert spine.status is Status.WITH_WARNINGS
    inside = Inside(TriangleMesh(starfish.meshes[0].vertices.double(), starfish.meshes[0].faces))
    assert bool(inside(spine.curves[0, 1].double()).float().mean() > 0.9)
    torch.testing.assert_close(spine.curves[:, 1, -1], spine.junctions[:, 0])


def forked(fork, frame):
    """A body whose first two limbs part at a distance from the middle, turned a little more in every frame."""
    middle, branch = torch.zeros(3, dtype=torch.float64), torch.tensor([fork, 0.0, 0.0], dtype=torch.float64)
    bones = [(branch, ENDS[0]), (branch, ENDS[1]), (middle, ENDS[2]), (middle, ENDS[3]), (middle, branch)]
    cones = [RoundCone(tuple(a.tolist()), tuple(b.tolist()), 0.1, 0.07) for a, b in bones]
    surface = mesh_of(cones, 0.04, 0.03)
    turn = so3_exp(frame * torch.tensor([0.05, 0.1, 0.15], dtype=torch.float64))
    return TriangleMesh(surface.vertices @ turn.mT, surface.faces), ENDS @ turn.mT


def straight_prior(fork):
    """The bones of `forked`; with the fork in the middle a star."""
    middle = torch.tensor([[0.0, 0.0, 0.0], [fork, 0.0, 0.0]], dtype=torch.float64)
    edges = [[0, 5], [1, 5], [2, 4], [3, 4], [4, 5]] if fork else [[0, 4], [1, 4], [2, 4], [3, 4]]
    nodes = torch.cat((ENDS, middle[: 2 if fork else 1]))
    return Skeleton(nodes, torch.tensor(edges), torch.full((len(nodes),), 0.1))


@pytest.fixture(scope="module")
def torn(tmp_path_factory):
    """Frames of which some are stars and others forks."""
    meshes, ends = zip(*(forked(fork, frame) for frame, fork in enumerate((0.0, 0.5, 0.5, 0.0))), strict=True)
    return meshes, torch.stack(ends), tmp_path_factory.mktemp("torn")


@pytest.mark.parametrize(("fork", "topology"), [(0.0, "(()()()())"), (0.5, FORK)])
def test_the_prior_says_which_tree_it_is_where_frames_differ(torn, fork, topology):
    meshes, ends, folder = torn
    for order in (torch.arange(4), torch.tensor([2, 0, 3, 1])):
        plain = straight_prior(fork)
        nodes = torch.cat((plain.nodes[order], plain.nodes[4:]))
        rows = {int(old): new for new, old in enumerate(order)}
        edges = torch.tensor([[rows.get(a, a), rows.get(b, b)] for a, b in plain.edges.tolist()])
        prior = Skeleton(nodes, edges, plain.radii).transformed(anywhere(5, 3.0))
        spine = extract_spine(meshes, prior=prior, workers=1, progress=folder)
        assert set(spine.topologies) == {topology}
        assert float((spine.tips - ends[:, order]).norm(dim=-1).max()) < 0.08
        assert spine.junctions.shape[1] == (2 if fork else 1)


def test_a_tree_that_no_frame_has_is_laid_along_the_limbs_of_each(tmp_path):
    meshes, ends = zip(*(forked(0.5, frame) for frame in range(2)), strict=True)
    spine = extract_spine(meshes, prior=straight_prior(0.0), workers=1, progress=tmp_path)
    assert set(spine.topologies) == {"(()()()())"}
    assert bool(spine.own.all())
    assert float((spine.tips - torch.stack(ends)).norm(dim=-1).max()) < 0.08


@pytest.mark.parametrize("seed", range(4))
def test_eight_arms_in_any_order_are_named_by_a_prior_in_another_pose(seed):
    sequence = creature_sequence(OCTOPUS, 6, resolution=16)
    generator = torch.Generator().manual_seed(seed)
    orders = torch.stack([torch.randperm(8, generator=generator) for _ in range(7)])
    skeletons = [axes_skeleton(sequence, frame, orders[frame]) for frame in range(6)]
    prior = axes_skeleton(sequence, 0, orders[6]).transformed(anywhere(seed, 1.0))
    labels = track_tips(skeletons[1:], prior=prior).labels
    assert torch.equal(orders[1:6].gather(1, labels), orders[6].expand(5, 8))


def test_superfluous_tips_are_left_out_where_asked_for(starfish, folder):
    four = axes_skeleton(starfish, 0, torch.tensor([4, 0, 2, 3]))
    message = r"prior must have the limbs of the data: it has 4 tips, most frames show 5; .* or num_tips=4"
    with pytest.raises(InputError, match=message):
        extract_spine(starfish.meshes, prior=four, workers=1, progress=folder)
    config = SpineConfig(num_tips=4)
    spine = extract_spine(starfish.meshes, prior=four, config=config, workers=1, progress=folder)
    assert torch.equal(nearest_arms(spine, starfish)[0], torch.tensor([4, 0, 2, 3]).expand(FRAMES, 4))
    assert all("1 superfluous tip(s) left out" in row for row in spine.warnings)


POINT = Skeleton(torch.zeros(1, 3), torch.zeros(0, 2).long(), torch.ones(1))
FLAT = Skeleton(torch.zeros(2, 3), torch.tensor([[0, 1]]), torch.ones(2))


@pytest.mark.parametrize(
    ("prior", "config", "error", "message"),
    [
        ("bones", None, InputTypeError, "prior must be a Skeleton or a SpineSequence, got str"),
        (POINT, None, InputError, r"prior must have two tips or more, apart from each other, got 1 tip\(s\)"),
        (FLAT, None, InputError, r"prior must have two tips or more, apart from each other, got 2 tip\(s\)"),
        (straight_prior(0.0), SpineConfig(num_tips=3), InputError, "num_tips must be that of the prior, 4, got 3"),
    ],
)
def test_what_is_no_prior_is_refused(starfish, prior, config, error, message):
    with pytest.raises(error, match=message):
        extract_spine(starfish.meshes, prior=prior, config=config)
