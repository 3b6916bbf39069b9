"""Names of tips over a whole sequence: relations on the surface, the most probable chain, the mirror of a body."""

from itertools import combinations, permutations, product

import pytest
import torch
from scipy.stats import multivariate_t

import torchreg as tr
from tests.spines.bodies import moved, random, shuffled, similarity
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import unit_sphere
from torchreg.spines.names import body_mirror, name_chain, name_model, student_t
from torchreg.spines.names.tip_features import TipFeatures, TipObservations
from torchreg.spines.skeleton.tip_relations import surface_relations


def relations(mesh, tips):
    vertices = torch.cdist(tips, mesh.vertices).argmin(-1)
    return surface_relations(mesh, GeodesicGraph.from_mesh(mesh).distances(vertices), vertices)


def test_volumes_are_those_that_distances_map_to_and_change_sign_in_a_mirror_not_by_pose_or_winding():
    ball, matrix = unit_sphere(3, dtype=torch.float64), similarity(2, 2.0)
    found = surface_relations(ball, random(3, 3) @ ball.vertices.mT, torch.tensor([0, 1, 2])).volumes
    volume = torch.linalg.det(ball.vertices[ball.faces]).sum() / 6
    assert float(found[0, 1, 2]) == pytest.approx(float(torch.linalg.det(random(3, 3)) * volume))
    bumpy = ball.vertices * (1 + 0.3 * (ball.vertices @ random(3, 1, seed=4)).sin())
    mesh, tips = tr.TriangleMesh(bumpy, ball.faces), bumpy[[3, 40, 77, 120]]
    found, mirror = relations(mesh, tips), torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    assert float(found.volumes.abs().max()) > 1e-3
    torch.testing.assert_close(found.volumes, -found.volumes.transpose(0, 1))
    for vertices, faces, ends, factor in (
        (bumpy, ball.faces.flip(1), tips, 1),
        (moved(bumpy, matrix), ball.faces, moved(tips, matrix), 8),
        (mirror * bumpy, ball.faces, mirror * tips, -1),
    ):
        again = relations(tr.TriangleMesh(vertices, faces), ends).volumes
        torch.testing.assert_close(again, factor * found.volumes)
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(found.of_tips(order).volumes, relations(mesh, tips[order]).volumes)


def test_densities_are_those_of_scipy():
    spread, points = random(4, 4), random(6, 5, seed=1)
    covariance, tails = spread @ spread.mT, student_t.TAILS
    density = student_t.GroupedDensity([student_t.FeatureGroup(torch.arange(4), 4)], [covariance])
    displacements = student_t.t_log_density(points[:, :3].square().sum(-1), torch.tensor(0.3).double(), 3)
    for found, shape, dof in (
        (density(points)[:, 0], covariance, tails.dof),
        (displacements, 0.09 * torch.eye(3).double(), tails.displacement_dof),
    ):
        wanted = multivariate_t(shape=shape.numpy(), df=dof).logpdf(points[:, : len(shape)].numpy())
        torch.testing.assert_close(found, torch.from_numpy(wanted))


def test_the_best_chain_and_the_chances_of_its_states_are_those_of_all_chains():
    start, steps = random(3), [random(3, 4, seed=1), random(4, 2, seed=2), random(2, 3, seed=3)]
    chains = list(product(range(3), range(4), range(2), range(3)))
    scores = torch.stack([start[c[0]] + sum(step[c[k], c[k + 1]] for k, step in enumerate(steps)) for c in chains])
    path, score = name_chain._best_path(start, steps)
    assert tuple(path) == chains[int(scores.argmax())]
    assert score == pytest.approx(float(scores.max()))
    chances = scores.softmax(0)
    for place, found in enumerate(name_chain._state_probabilities(start, steps)):
        wanted = torch.zeros_like(found).index_add(0, torch.tensor([c[place] for c in chains]), chances)
        torch.testing.assert_close(found, wanted)


def test_names_one_step_away_and_exchanges_of_mirrored_names_are_all_there_are():
    names = (2, 0, -1)
    found = {tuple(row) for row in name_chain._exchanged(torch.tensor([names]), 4).tolist()}
    every = {row for row in product(range(-1, 4), repeat=3) if len([k for k in row if k >= 0]) == len({*row} - {-1})}
    moves = {row for row in every if sum(a != b for a, b in zip(row, names, strict=True)) <= 1}
    assert found == moves | {(0, 2, -1), (-1, 0, 2), (2, -1, 0)}
    for count, number in ((3, 4), (5, 26), (6, 76)):  # permutations that undo themselves
        rows = torch.tensor(list(body_mirror._exchanges(list(range(count)), 0)))
        assert rows[0].tolist() == list(range(count))
        assert len(rows.unique(dim=0)) == len(rows) == number
        assert bool((rows.gather(1, rows) == torch.arange(count)).all())


def test_residuals_of_distances_do_not_depend_on_where_the_end_of_a_limb_lies():
    features = TipFeatures(5, 1, with_volumes=False)
    distances = random(5, 5, seed=3).abs()
    shift = torch.tensor([0.0, 0, 0.7, 0, 0]).double()

    def of(rows):
        zeros = (torch.zeros(5, 8, 3).double(), rows, torch.zeros(5, 5, 5).double(), torch.zeros(5, 1).double())
        return features(TipObservations(*zeros), torch.arange(5)[None], torch.zeros(10).double())[0]

    change = of(distances + distances.mT + shift[:, None] + shift) - of(distances + distances.mT)
    torch.testing.assert_close(change[:5], shift)
    assert float(change[5:].abs().max()) < 1e-12


CROSSED = {
    "distances": [[0, 2.0, 1.0, 1.2], [2.0, 0, 1.2, 1.0], [1.0, 1.2, 0, 1.5], [1.2, 1.0, 1.5, 0]],
    "roots": [[-0.1, 0, 0.0], [0.1, 0, 0], [-0.3, 0, 1], [0.3, 0, 1]],
    "ends": [[0.0, -0.8, 0]] * 4,
}
LIFTED = {
    "distances": [[0, 1.0, 1.5, 1.55, 1.7], [1.0, 0, 1.55, 1.5, 1.7], [1.5, 1.55, 0, 1.3, 1.0],
                  [1.55, 1.5, 1.3, 0, 1.0], [1.7, 1.7, 1.0, 1.0, 0]],
    "roots": [[-0.1, 0, 0], [0.1, 0, 0], [-0.2, 0, 0.6], [0.2, 0, 0.6], [0, 0, 0.7]],
    "ends": [[0.08, 0, -0.8], [-0.08, 0, -0.8], [-0.3, 0, -0.5], [0.3, 0, -0.5], [0, 0, 0.2]],
}  # fmt: skip


def walking(body, num_frames, *, lift):
    """Frames of a body of which only distances between tips are measured, and the shuffled orders of the tips.

    Two feet pass each other from frame to frame, or are lifted in turn, which brings them near the other tips.
    """
    wanted, roots, ends = (torch.tensor(body[name]).double() for name in ("distances", "roots", "ends"))
    count, frames, orders = len(roots), [], []
    usual = torch.tensor([-2.0, -2, -2.5, -2.5, -1.5]).double()[:count]
    for number in range(num_frames):
        phase, up = torch.tensor(torch.pi * number / 4), torch.zeros(count).double()
        side = phase.sin() if lift else torch.tensor((-1.0) ** number)
        up[:2] = torch.stack((side, -side)).clamp_min(0 if lift else -1)
        shift = torch.stack((0 * up, 0.3 * up * lift, (0.6 if lift else 0.2) * up), 1)
        tips = roots + ends + shift
        curves = tips[:, None] + torch.linspace(0, 1, 8).double()[:, None] * (roots - tips)[:, None]
        noise = 0.003 * random(count, count, seed=number) - 0.15 * lift * up
        limbs = torch.stack((wanted.mean(1) - 0.3 * lift * up, usual), 1) + 0.01 * random(count, 2)
        order = shuffled(count, number)
        distances = (wanted + noise + noise.mT).fill_diagonal_(0)[order][:, order]
        frames.append(TipObservations(curves[order], distances, torch.zeros(3 * [count]).double(), limbs[order]))
        orders.append(order)
    return frames, orders


@pytest.mark.parametrize(("body", "lift", "reference"), [(CROSSED, False, 4), (LIFTED, True, 2)])
def test_legs_keep_their_names_in_any_order_of_tips(body, lift, reference):
    frames, orders = walking(body, 9, lift=lift)
    found = name_chain.name_over_time(frames, reference, torch.arange(len(body["roots"])))
    names = torch.stack([order[row] for order, row in zip(orders, found.labels, strict=True)])
    assert bool((names == orders[reference]).all())
    assert bool((found.confidence[reference] == 1).all())
    if not lift:
        assert bool((found.confidence > 0.5).all())


def test_a_body_differs_from_its_mirror_image_in_as_many_dimensions_as_its_features_can():
    signs = {order: (-1) ** (sum(a > b for a, b in combinations(order, 2))) for order in permutations(range(3))}
    kinds, names, zeros = (
        TipFeatures(5, 3, with_volumes=True),
        torch.tensor([[1, 0, 3, 2, 4]]),
        torch.zeros(10).double(),
    )
    frames = []
    for number in range(40):
        distances, volumes = random(5, 5, seed=number), random(5, 5, 5, seed=number)
        odd = sum(sign * volumes.permute(*order) for order, sign in signs.items())
        frames.append(TipObservations(random(5, 8, 3), distances + distances.mT, odd, random(5, 3, seed=number)))
    own = torch.arange(5)[None]
    offsets = torch.cat([kinds(frame, own, zeros) - kinds(frame.mirrored(), names, zeros) for frame in frames])
    ranks = [int(torch.linalg.matrix_rank(offsets[:, group.index], rtol=1e-6)) for group in kinds.groups]
    background = name_model._background(kinds, frames)[1]
    assert body_mirror._sizes(kinds, background, names)[0].tolist() == ranks


def test_the_mirror_of_a_body_is_found_and_limbs_that_are_all_alike_have_none():
    frames, orders = walking(LIFTED, 9, lift=True)
    names, kinds = torch.stack([order.argsort() for order in orders]), TipFeatures(5, 2, with_volumes=False)
    names[3, :2] = names[3, [1, 0]].clone()  # a wrong name does not matter
    names[4, 2] = -1
    found = body_mirror.find_mirror(kinds, name_model._background(kinds, frames)[1], frames, names)
    assert found.names.tolist() == [1, 0, 3, 2, 4]
    alike = [
        TipObservations(row.curves, 1 + 0.02 * (d + d.mT), row.volumes, 1 + 0.02 * random(5, 2, seed=k))
        for k, row in enumerate(frames)
        for d in [random(5, 5, seed=k)]
    ]
    assert body_mirror.find_mirror(kinds, name_model._background(kinds, alike)[1], alike, names) is None
