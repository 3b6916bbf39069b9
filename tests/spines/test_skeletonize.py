"""Skeletons of single surfaces: tips, topology and axes against the truth, on sound and unsound meshes."""

import math

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import STAR, circle, line, moved, random, shuffled, tube
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.mesh import concatenate, unit_sphere
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.spines.skeleton.clearance import Inside

BALL = unit_sphere(2, dtype=torch.float64)


TURN = torch.linspace(0, 1.2 * math.pi, 200).double()
SPIRAL = torch.stack((TURN.cos(), TURN.sin(), 0.3 * TURN), dim=1)


@pytest.fixture(scope="module")
def star():
    return creature_sequence(STARFISH, 1, resolution=48)


@pytest.fixture(scope="module")
def skeleton(star):
    return tr.skeletonize(star.meshes[0])


def test_a_starfish_has_five_tips_and_one_junction_of_degree_five(star, skeleton):
    assert skeleton.topology == star.topology == STAR
    assert skeleton.degrees[skeleton.junctions].tolist() == [5]
    apart = torch.cdist(star.tips[0], skeleton.nodes[skeleton.tips])
    assert sorted(apart.argmin(1).tolist()) == list(range(5))
    assert apart.amin(1).max() < 0.08
    assert bool(Inside(star.meshes[0])(skeleton.nodes).all())
    assert skeleton.notes == ()
    assert skeleton.confidence.min() > 0.9
    assert (skeleton.nodes[skeleton.junctions[0]] - star.curves[0, 0, 0]).norm() < 0.05


@pytest.mark.parametrize("ends", [(0.2, 0.2), (0.3, 0.15)])
def test_a_tube_has_its_axis_for_a_skeleton(ends):
    radii = torch.linspace(*ends, 200).double()
    found = tr.skeletonize(tube(SPIRAL, radii))
    assert found.topology == "(())"
    distance, nearest = torch.cdist(found.nodes, SPIRAL).min(1)
    inner = (nearest > 0) & (nearest < 199)  # the round ends reach beyond the axis
    assert inner.sum() > 0.8 * len(inner)
    assert (distance / radii[nearest])[inner].max() < 0.1
    assert (found.radii / radii[nearest])[inner].sub(1).abs().max() < 0.15
    # Frames look along the axis, and their signs carry on.
    limb = found.limbs[0]
    along = torch.nn.functional.normalize(found.nodes[limb[1:]] - found.nodes[limb[:-1]], dim=1)
    assert (along * found.frames[limb[:-1], :, 2]).sum(1).min() > 0.95
    assert (found.frames[limb, :, 0][1:] * found.frames[limb, :, 0][:-1]).sum(1).min() > 0.9


def test_rigid_motion_and_scale_change_nothing_but_coordinates(star, skeleton):
    motion = se3_exp(torch.tensor([3.0, -2.0, 1.0, 0.5, 1.0, -0.7]))
    mesh, matrix = star.meshes[0], rigid_matrix(40 * motion[:3, :3], motion[:3, 3])
    again = tr.skeletonize(tr.TriangleMesh(moved(mesh.vertices, matrix), mesh.faces))
    expected = skeleton.transformed(matrix)
    assert torch.equal(again.edges, expected.edges)
    assert torch.allclose(again.nodes, expected.nodes, atol=40 * 2e-4)
    assert torch.allclose(again.radii, expected.radii, atol=40 * 2e-4)
    assert torch.allclose(again.frames[:, :, 2], expected.frames[:, :, 2], atol=1e-2)


@pytest.mark.parametrize(("change", "limit"), [("mixed", 0.04), ("noisy", 0.1), ("coarse", 0.04)])
def test_order_winding_noise_and_coarsening_do_not_matter(star, skeleton, change, limit):
    vertices, faces = star.meshes[0].vertices, star.meshes[0].faces
    if change == "mixed":
        faces = faces[shuffled(len(faces), 0)]
        faces[::3] = faces[::3].flip(1)
    if change == "noisy":  # a fifth of the length of an edge
        vertices = vertices + 0.2 / 24 * random(*vertices.shape).float()
    config = tr.SkeletonizeConfig(max_vertices=1000) if change == "coarse" else None
    found = tr.skeletonize(tr.TriangleMesh(vertices, faces), config)
    assert found.topology == STAR
    assert torch.cdist(found.nodes, skeleton.nodes).amin(1).max() < limit
    assert torch.cdist(star.tips[0], found.nodes[found.tips]).amin(1).max() < 0.1


def test_holes_are_closed_and_noted_and_fragments_left_out_by_policy(star):
    mesh = star.meshes[0]
    middles = mesh.vertices[mesh.faces].mean(1)
    rim = middles[(middles - star.curves[0, 2, 24]).norm(dim=1).argmin()]
    found = tr.skeletonize(tr.TriangleMesh(mesh.vertices, mesh.faces[(middles - rim).norm(dim=1) > 0.1]))
    assert found.topology == STAR
    assert any("hole" in note for note in found.notes)
    assert Inside(mesh)(found.nodes).float().mean() > 0.995
    pair = concatenate([tr.TriangleMesh(0.05 * BALL.vertices.float() + 2, BALL.faces), mesh])
    found = tr.skeletonize(pair)
    assert found.topology == STAR
    assert found.notes[0].startswith("1 fragment(s) left out")
    with pytest.raises(tr.errors.InputError, match="mesh must be one piece, got 2"):
        tr.skeletonize(pair, tr.SkeletonizeConfig(pieces="error"))


def test_what_the_body_stands_on_is_left_out_or_kept(star):
    mesh = star.meshes[0]
    low = float(mesh.vertices[:, 2].min())
    corners = mesh.vertices.new_tensor([[-3, -3, low], [3, -3, low], [3, 3, low], [-3, 3, low]])
    both = concatenate([mesh, tr.TriangleMesh(corners, [[0, 1, 2], [0, 2, 3]])])
    words = f"4 of {mesh.num_vertices + 4} points of mesh lie on the plane"
    with pytest.warns(tr.errors.FileWarning, match=words) as warned:
        assert tr.skeletonize(both).topology == STAR
    assert len(warned) == 1
    assert tr.skeletonize(both, support="keep").topology != STAR


def test_a_limb_in_two_pieces_and_loops_are_bridged():
    limb = concatenate([tube(line([x, 0.0, 0.0], [x + 2, 0.0, 0.0], 80), 0.2) for x in (0.0, 2.6)])
    bridge = tr.SkeletonizeConfig(pieces="bridge")
    found = tr.skeletonize(limb, bridge)
    assert found.topology == "(())"
    assert float(found.length) == pytest.approx(5.0, rel=0.05)
    assert found.nodes[:, 1:].norm(dim=1).max() < 0.03
    assert found.notes == ("2 pieces joined by 1 bridges",)
    assert float(tr.skeletonize(limb).length) < 2.5
    rings = concatenate([tube(circle(count=100) + torch.tensor([x, 0.0, 0.0]), 0.2, 0.1) for x in (0.0, 2.8)])
    found = tr.skeletonize(rings, bridge)
    assert found.notes[0] == "2 pieces joined by 1 bridges"
    assert float(found.nodes[:, 0].max() - found.nodes[:, 0].min()) > 4


def test_a_thin_limb_is_found():
    arms = torch.cat([line([0.0, 0, 0], end, 200) for end in ([2.0, 0, 0], [0.0, 2, 0])])
    mesh = tube(torch.cat((torch.zeros(1, 3).double(), arms)), torch.tensor([0.5, *[0.04] * 400]), 0.05)
    found = tr.skeletonize(mesh)
    ends = torch.tensor([[2.0, 0, 0], [0, 2, 0]]).double()
    assert torch.cdist(ends, found.nodes[found.tips]).amin(1).max() < 0.15


def test_a_long_loop_is_cut_and_noted():
    mesh = tube(circle(), 0.2, 0.08)
    found = tr.skeletonize(mesh)
    assert found.topology == "(())"
    assert found.notes == ("1 loop(s) cut",)
    assert found.confidence.min() > 0.5
    assert float(found.length) == pytest.approx(2 * math.pi, rel=0.1)
    assert (found.nodes[:, :2].norm(dim=1) - 1).abs().max() < 0.1
    bypassed = tr.skeletonize(mesh, tr.SkeletonizeConfig(min_protrusion=2.0))
    assert bypassed.topology == "(())"
    assert bypassed.confidence.tolist() == [0, 0]


def test_a_ball_is_a_single_limb_of_no_confidence_and_the_smallest_surfaces_have_one():
    found = tr.skeletonize(BALL)
    assert found.topology == "(())"
    assert found.confidence.tolist() == [0, 0]
    assert "no limb stands out" in found.notes[0]
    assert found.nodes.norm(dim=1).max() < 1
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    for count, faces in ((4, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]), (3, [[0, 1, 2]])):
        found = tr.skeletonize(tr.TriangleMesh(corners[:count], torch.tensor(faces)))
        assert len(found.tips) >= 2
        assert bool(torch.isfinite(found.nodes).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_mesh_and_repeat(dtype):
    mesh = tube(SPIRAL[::3], 0.3, 0.15).to(dtype)
    found = tr.skeletonize(mesh)
    assert {value.dtype for value in (found.nodes, found.radii, found.frames, found.confidence)} == {dtype}
    assert torch.equal(tr.skeletonize(mesh).nodes, found.nodes)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: tr.skeletonize("points"), "InputTypeError", "mesh must be a TriangleMesh, got str"),
        (lambda: tr.skeletonize(torch.full((200, 3), torch.nan)), "InputError", "mesh must"),
        (lambda: tr.skeletonize(tr.TriangleMesh(torch.zeros(3, 3), torch.zeros(0, 3).long())), "InputError",
         "three different corners"),
        (lambda: tr.skeletonize(tr.TriangleMesh(1e200 * BALL.vertices, BALL.faces)), "InputError",
         "mesh must have a finite area"),
        (lambda: tr.SkeletonizeConfig(min_protrusion=0.0), "InputError", "min_protrusion must be positive"),
        (lambda: tr.SkeletonizeConfig(pieces="all"), "InputError", "pieces must be one of"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(call, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        call()
