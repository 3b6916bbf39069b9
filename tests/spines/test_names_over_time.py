"""Names of tips over a whole sequence at once: what surfaces tell, the most probable chain, and how sure it is."""

from itertools import permutations, product

import pytest
import torch
from scipy.stats import multivariate_t

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.spines.extract_spine import extract_spine
from torchreg.spines.names.name_chain import _best_path, _exchanged, _state_probabilities, name_over_time
from torchreg.spines.names.name_model import relative_maps
from torchreg.spines.names.student_t import TAILS, FeatureGroup, GroupedDensity, t_log_density
from torchreg.spines.names.tip_features import TipFeatures, TipObservations
from torchreg.spines.skeleton.tip_relations import surface_relations
from torchreg.storage import load


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def relations(mesh, tips):
    vertices = torch.cdist(tips, mesh.vertices).argmin(-1)
    return surface_relations(mesh, GeodesicGraph.from_mesh(mesh).distances(vertices), vertices)


def test_the_volume_of_three_distances_is_that_of_the_surface_that_they_map_to():
    ball = unit_sphere(3, dtype=torch.float64)
    linear = random(3, 3) @ ball.vertices.mT
    found = surface_relations(ball, linear, torch.tensor([0, 1, 2])).volumes
    volume = torch.linalg.det(ball.vertices[ball.faces]).sum() / 6
    assert float(found[0, 1, 2]) == pytest.approx(float(torch.linalg.det(random(3, 3)) * volume))


def test_relations_tell_a_body_from_its_mirror_image_and_not_its_pose_or_winding():
    ball = unit_sphere(3, dtype=torch.float64)
    bumpy = ball.vertices * (1 + 0.3 * (ball.vertices @ random(3, 1, seed=4)).sin())
    mesh, tips = TriangleMesh(bumpy, ball.faces), bumpy[[3, 40, 77, 120]]
    found = relations(mesh, tips)
    assert float(found.volumes.abs().max()) > 1e-3
    torch.testing.assert_close(found.volumes, -found.volumes.transpose(0, 1))
    torch.testing.assert_close(relations(TriangleMesh(bumpy, ball.faces.flip(1)), tips).volumes, found.volumes)
    turn = so3_exp(random(3, seed=2))
    moved = relations(TriangleMesh(2 * bumpy @ turn.mT + 3, ball.faces), 2 * tips @ turn.mT + 3)
    torch.testing.assert_close(moved.volumes, 8 * found.volumes)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(
        relations(TriangleMesh(mirror * bumpy, ball.faces), mirror * tips).volumes, -found.volumes
    )
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(found.of_tips(order).volumes, relations(mesh, tips[order]).volumes)


def test_densities_are_those_of_scipy():
    spread = random(4, 4)
    covariance, points = spread @ spread.mT, random(6, 5, seed=1)
    density = GroupedDensity([FeatureGroup(torch.arange(4), 4)], [covariance])
    wanted = multivariate_t(shape=covariance.numpy(), df=TAILS.dof).logpdf(points[:, :4].numpy())
    torch.testing.assert_close(density(points)[:, 0], torch.from_numpy(wanted))
    scale = torch.tensor(0.3, dtype=torch.float64)
    wanted = multivariate_t(shape=0.09 * torch.eye(3).double().numpy(), df=TAILS.displacement_dof)
    found = t_log_density(points[:, :3].square().sum(-1), scale, 3)
    torch.testing.assert_close(found, torch.from_numpy(wanted.logpdf(points[:, :3].numpy())))


def test_the_best_chain_and_the_chances_of_its_states_are_those_of_all_chains():
    start, steps = random(3), [random(3, 4, seed=1), random(4, 2, seed=2), random(2, 3, seed=3)]
    chains = list(product(range(3), range(4), range(2), range(3)))
    scores = torch.stack([start[c[0]] + sum(step[c[k], c[k + 1]] for k, step in enumerate(steps)) for c in chains])
    path, score = _best_path(start, steps)
    assert tuple(path) == chains[int(scores.argmax())]
    assert score == pytest.approx(float(scores.max()))
    chances = scores.softmax(0)
    for place, found in enumerate(_state_probabilities(start, steps)):
        wanted = torch.zeros_like(found).index_add(0, torch.tensor([c[place] for c in chains]), chances)
        torch.testing.assert_close(found, wanted)


def test_names_one_step_away_are_all_that_differ_by_an_exchange_or_one_tip():
    names = torch.tensor([[2, 0, -1]])
    found = {tuple(row) for row in _exchanged(names, 4).tolist()}
    every = {row for row in product(range(-1, 4), repeat=3) if len([k for k in row if k >= 0]) == len({*row} - {-1})}
    swaps = {
        tuple(names[0, list(order)].tolist())
        for order in permutations(range(3))
        if sum(k != place for place, k in enumerate(order)) == 2
    }
    moves = {row for row in every if sum(a != b for a, b in zip(row, names[0].tolist(), strict=True)) <= 1}
    assert found == swaps | moves


def test_tips_follow_their_names_from_frame_to_frame():
    before, after = torch.tensor([[2, 0, -1], [1, 2, 0]]), torch.tensor([[0, 1, 2]])
    assert relative_maps(before, after, 3).tolist() == [[[1, -1, 0]], [[2, 0, 1]]]


def test_what_is_left_of_distances_does_not_feel_where_the_end_of_a_limb_lies():
    features = TipFeatures(5, 1, with_volumes=False)
    distances = random(5, 5, seed=3).abs()
    distances = distances + distances.mT
    shift = torch.zeros(5).double()
    shift[2] = 0.7
    moved = distances + shift[:, None] + shift
    maps = torch.arange(5)[None]

    def of(rows):
        frame = TipObservations(
            torch.zeros(5, 8, 3).double(), rows, torch.zeros(5, 5, 5).double(), torch.zeros(5, 1).double()
        )
        return features(frame, maps, torch.zeros(10).double())[0]

    change = of(moved) - of(distances)
    torch.testing.assert_close(change[:5], shift)
    assert float(change[5:].abs().max()) < 1e-12


def crossing_legs(num_frames):
    """Feet that pass each other between frames, told by their distances to two hands; and the orders of the tips."""
    wanted = torch.tensor([[0, 2.0, 1.0, 1.2], [2.0, 0, 1.2, 1.0], [1.0, 1.2, 0, 1.5], [1.2, 1.0, 1.5, 0]]).double()
    roots = torch.tensor([[-0.1, 0, 0.0], [0.1, 0, 0], [-0.3, 0, 1], [0.3, 0, 1]]).double()
    share, frames, orders = torch.linspace(0, 1, 8).double()[:, None], [], []
    for number in range(num_frames):
        stride = 0.2 * (-1) ** number * torch.tensor([1.0, -1, 0, 0]).double()
        tips = roots + torch.stack((torch.zeros(4), torch.full((4,), -0.8), stride), 1).double()
        curves = tips[:, None] + share * (roots - tips)[:, None] + 0.01 * random(4, 8, 3, seed=number)
        noise = 0.01 * random(4, 4, seed=50 + number)
        order = torch.randperm(4, generator=torch.Generator().manual_seed(number))
        distances = (wanted + noise + noise.mT)[order][:, order]
        orders.append(order)
        frames.append(
            TipObservations(curves[order], distances, torch.zeros(4, 4, 4).double(), torch.zeros(4, 1).double())
        )
    return frames, orders


def test_legs_that_pass_each_other_keep_their_names_in_any_order_of_tips():
    frames, orders = crossing_legs(9)
    found = name_over_time(frames, 4, torch.arange(4))
    names = torch.stack([order[row] for order, row in zip(orders, found.labels, strict=True)])
    assert bool((names == orders[4]).all())
    assert bool((found.confidence > 0.5).all())
    assert bool((found.confidence[4] == 1).all())


def test_confidence_of_a_spine_has_a_value_for_every_tip_and_frame_and_is_kept(tmp_path):
    spine = extract_spine(creature_sequence(STARFISH, 3, resolution=32).meshes, workers=1)
    assert spine.confidence.shape == spine.found.shape
    assert bool(((spine.confidence > 0.5) & (spine.confidence <= 1)).all())
    spine.save(tmp_path / "spine.safetensors")
    assert torch.equal(load(tmp_path / "spine.safetensors").confidence, spine.confidence)
