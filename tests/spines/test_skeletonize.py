"""Skeletons of single surfaces: tips, topology and axes against the truth, on sound and unsound meshes."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import FileWarning, InputError, InputTypeError
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.spines.skeleton.clearance import Inside
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize

STAR = "(()()()()())"


def tube(axis, radius, spacing=0.07):
    """Return the surface around a polyline (n, 3), its radius linear from one end to the other if two are given."""
    radius = torch.as_tensor(radius, dtype=torch.float64).expand(2)

    def field(points):
        share = torch.linspace(0, 1, len(axis)).double()
        table = torch.cdist(points, axis)
        return (table - (radius[0] + share * (radius[1] - radius[0]))).amin(1)

    margin = float(radius.max()) + 2 * spacing
    return isosurface(field, axis.amin(0) - margin, axis.amax(0) + margin, spacing)


def bend(count=200):
    turn = torch.linspace(0, 1.2 * math.pi, count).double()
    return torch.stack((turn.cos(), turn.sin(), 0.3 * turn), dim=1)


@pytest.fixture(scope="module")
def star():
    return creature_sequence(STARFISH, 1, resolution=48)


@pytest.fixture(scope="module")
def star_skeleton(star):
    return skeletonize(star.meshes[0])


def test_a_starfish_has_five_tips_and_one_junction_of_degree_five(star, star_skeleton):
    assert star_skeleton.topology == star.topology == STAR
    assert star_skeleton.degrees[star_skeleton.junctions].tolist() == [5]
    apart = torch.cdist(star.tips[0], star_skeleton.nodes[star_skeleton.tips])
    assert sorted(apart.argmin(1).tolist()) == list(range(5))
    assert apart.amin(1).max() < 0.08
    assert bool(Inside(star.meshes[0])(star_skeleton.nodes).all())
    assert star_skeleton.notes == ()
    assert star_skeleton.confidence.min() > 0.9
    hub = star_skeleton.nodes[star_skeleton.junctions[0]]
    assert (hub - star.curves[0, 0, 0]).norm() < 0.05


@pytest.mark.parametrize(("radius", "axis"), [(0.2, bend()), ((0.3, 0.15), bend())])
def test_a_tube_has_its_axis_for_a_skeleton(radius, axis):
    skeleton = skeletonize(tube(axis, radius))
    assert skeleton.topology == "(())"
    radii = torch.linspace(*torch.as_tensor(radius).expand(2).tolist(), len(axis)).double()
    distance, nearest = torch.cdist(skeleton.nodes, axis).min(1)
    # The round ends reach beyond the axis.
    beside = (nearest > 0) & (nearest < len(axis) - 1)
    assert beside.sum() > 0.8 * len(beside)
    assert (distance / radii[nearest])[beside].max() < 0.1
    assert (skeleton.radii / radii[nearest])[beside].sub(1).abs().max() < 0.15
    # Frames look along the axis, and their signs carry on.
    limb = skeleton.limbs[0]
    along = torch.nn.functional.normalize(skeleton.nodes[limb[1:]] - skeleton.nodes[limb[:-1]], dim=1)
    assert (along * skeleton.frames[limb[:-1], :, 2]).sum(1).min() > 0.95
    first = skeleton.frames[limb, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.9


def test_rigid_motion_and_scale_change_nothing_but_coordinates(star, star_skeleton):
    motion = se3_exp(torch.tensor([3.0, -2.0, 1.0, 0.5, 1.0, -0.7]))
    motion = rigid_matrix(40 * motion[:3, :3], motion[:3, 3])
    mesh = star.meshes[0]
    moved = skeletonize(TriangleMesh(mesh.vertices @ motion[:3, :3].mT + motion[:3, 3], mesh.faces))
    expected = star_skeleton.transformed(motion)
    assert torch.equal(moved.edges, expected.edges)
    assert torch.allclose(moved.nodes, expected.nodes, atol=40 * 2e-4)
    assert torch.allclose(moved.radii, expected.radii, atol=40 * 2e-4)
    assert torch.allclose(moved.frames[:, :, 2], expected.frames[:, :, 2], atol=1e-2)


def test_winding_and_order_of_faces_do_not_matter(star, star_skeleton):
    mesh = star.meshes[0]
    faces = mesh.faces[torch.randperm(mesh.num_faces, generator=torch.Generator().manual_seed(0))]
    faces[::3] = faces[::3].flip(1)
    turned = skeletonize(TriangleMesh(mesh.vertices, faces))
    assert turned.topology == STAR
    assert torch.cdist(turned.nodes, star_skeleton.nodes).amin(1).max() < 0.04


def test_noise_is_no_limb(star):
    mesh = star.meshes[0]
    noise = torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    # A fifth of a voxel, which is a fifth of the length of an edge.
    noisy = TriangleMesh(mesh.vertices + 0.2 / 24 * noise, mesh.faces)
    skeleton = skeletonize(noisy)
    assert skeleton.topology == STAR
    assert torch.cdist(star.tips[0], skeleton.nodes[skeleton.tips]).amin(1).max() < 0.1


def test_holes_are_closed_and_told(star):
    mesh = star.meshes[0]
    middles = mesh.vertices[mesh.faces].mean(1)
    arm = star.curves[0, 2, star.curves.shape[2] // 2]
    rim = middles[(middles - arm).norm(dim=1).argmin()]
    open_mesh = TriangleMesh(mesh.vertices, mesh.faces[(middles - rim).norm(dim=1) > 0.1])
    assert open_mesh.num_faces < mesh.num_faces
    skeleton = skeletonize(open_mesh)
    assert skeleton.topology == STAR
    assert any("hole" in note for note in skeleton.notes)
    assert Inside(mesh)(skeleton.nodes).float().mean() > 0.995


def test_what_the_body_stands_on_is_left_out_or_kept(star):
    mesh = star.meshes[0]
    low = float(mesh.vertices[:, 2].min())
    table = TriangleMesh(
        mesh.vertices.new_tensor([[-3, -3, low], [3, -3, low], [3, 3, low], [-3, 3, low]]), [[0, 1, 2], [0, 2, 3]]
    )
    with pytest.warns(FileWarning, match=f"4 of {mesh.num_vertices + 4} points of mesh lie on the plane") as told:
        skeleton = skeletonize(concatenate([mesh, table]))
    assert len(told) == 1
    assert skeleton.topology == STAR
    assert skeletonize(concatenate([mesh, table]), support="keep").topology != STAR


def test_fragments_by_policy(star):
    mesh, ball = star.meshes[0], unit_sphere(2)
    pair = concatenate([TriangleMesh(0.05 * ball.vertices + 2, ball.faces), mesh])
    skeleton = skeletonize(pair)
    assert skeleton.topology == STAR
    assert skeleton.notes[0].startswith("1 fragment(s) left out")
    with pytest.raises(InputError, match="mesh must be one piece, got 2"):
        skeletonize(pair, SkeletonizeConfig(pieces="error"))


def test_a_limb_in_two_pieces_is_bridged():
    straight = torch.stack((torch.linspace(0, 2, 80), torch.zeros(80), torch.zeros(80)), dim=1).double()
    parts = [tube(straight + torch.tensor([x, 0.0, 0.0]), 0.2) for x in (0.0, 2.6)]
    skeleton = skeletonize(concatenate(parts), SkeletonizeConfig(pieces="bridge"))
    assert skeleton.topology == "(())"
    assert float(skeleton.length) == pytest.approx(5.0, rel=0.05)
    assert skeleton.nodes[:, 1:].norm(dim=1).max() < 0.03
    assert skeleton.notes == ("2 pieces joined by 1 bridges",)
    assert float(skeletonize(concatenate(parts)).length) < 2.5


def test_loops_of_bridged_surfaces_are_bypassed():
    turn = torch.linspace(0, 2 * math.pi, 100).double()
    ring = torch.stack((turn.cos(), turn.sin(), 0 * turn), dim=1)
    pair = concatenate([tube(ring + torch.tensor([x, 0.0, 0.0]), 0.2, 0.1) for x in (0.0, 2.8)])
    skeleton = skeletonize(pair, SkeletonizeConfig(pieces="bridge"))
    assert skeleton.notes[0] == "2 pieces joined by 1 bridges"
    assert float(skeleton.nodes[:, 0].max() - skeleton.nodes[:, 0].min()) > 4


def test_a_thin_limb_is_found():
    ball = torch.zeros(1, 3).double()
    arm = torch.stack((torch.linspace(0, 2, 200), torch.zeros(200), torch.zeros(200)), dim=1).double()

    def field(points):
        thin = torch.minimum(torch.cdist(points, arm).amin(1), torch.cdist(points, arm.roll(1, 1)).amin(1)) - 0.04
        return torch.minimum(torch.cdist(points, ball)[:, 0] - 0.5, thin)

    lower, upper = torch.tensor([-0.6, -0.6, -0.6]).double(), torch.tensor([2.2, 2.2, 0.6]).double()
    skeleton = skeletonize(isosurface(field, lower, upper, 0.05))
    ends = skeleton.nodes[skeleton.tips]
    assert torch.cdist(torch.tensor([[2.0, 0, 0], [0, 2, 0]]).double(), ends).amin(1).max() < 0.15


def test_a_long_loop_is_cut_and_told():
    turn = torch.linspace(0, 2 * math.pi, 200).double()
    ring = torch.stack((turn.cos(), turn.sin(), 0 * turn), dim=1)
    mesh = tube(ring, 0.2, 0.08)
    skeleton = skeletonize(mesh)
    assert skeleton.topology == "(())"
    assert skeleton.notes == ("1 loop(s) cut",)
    assert skeleton.confidence.min() > 0.5
    assert float(skeleton.length) == pytest.approx(2 * math.pi, rel=0.1)
    assert (skeleton.nodes[:, :2].norm(dim=1) - 1).abs().max() < 0.1
    bypassed = skeletonize(mesh, SkeletonizeConfig(min_protrusion=2.0))
    assert bypassed.topology == "(())"
    assert bypassed.confidence.tolist() == [0, 0]


def test_a_ball_is_a_single_limb_of_no_confidence():
    skeleton = skeletonize(unit_sphere(3, dtype=torch.float64))
    assert skeleton.topology == "(())"
    assert skeleton.confidence.tolist() == [0, 0]
    assert "no limb stands out" in skeleton.notes[0]
    assert skeleton.nodes.norm(dim=1).max() < 1


def test_large_surfaces_are_coarsened(star, star_skeleton):
    skeleton = skeletonize(star.meshes[0], SkeletonizeConfig(max_vertices=1000))
    assert skeleton.topology == STAR
    assert torch.cdist(skeleton.nodes, star_skeleton.nodes).amin(1).max() < 0.04


def test_the_smallest_surface_there_is():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    skeleton = skeletonize(TriangleMesh(corners, torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])))
    assert len(skeleton.tips) >= 2
    assert bool(torch.isfinite(skeleton.nodes).all())
    flat = skeletonize(TriangleMesh(corners[:3], torch.tensor([[0, 1, 2]])))
    assert bool(torch.isfinite(flat.nodes).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_mesh(dtype):
    mesh = tube(bend(60), 0.3, 0.15).to(dtype)
    skeleton = skeletonize(mesh)
    assert {value.dtype for value in (skeleton.nodes, skeleton.radii, skeleton.frames, skeleton.confidence)} == {dtype}
    again = skeletonize(mesh)
    assert torch.equal(again.nodes, skeleton.nodes)


def test_bad_input_is_refused():
    with pytest.raises(InputTypeError, match="mesh must be a TriangleMesh, got str"):
        skeletonize("points")
    with pytest.raises(InputError, match="three different corners"):
        skeletonize(TriangleMesh(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64)))
    ball = unit_sphere(2, dtype=torch.float64)
    with pytest.raises(InputError, match="mesh must have a finite area"):
        skeletonize(TriangleMesh(1e200 * ball.vertices, ball.faces))
    with pytest.raises(InputError, match="min_protrusion must be positive"):
        SkeletonizeConfig(min_protrusion=0.0)
    with pytest.raises(InputError, match="pieces must be one of"):
        SkeletonizeConfig(pieces="all")
    assert tr.skeletonize is skeletonize
