import math

import pytest
import torch

from experiments.made_up.bodies import Proportions, person, quadruped
from experiments.made_up.gaits import GAITS, animal_walk, person_walk
from torchreg.datasets.figures import Part, bending_figure, jointed_figure
from torchreg.datasets.solids import RoundBox, RoundCone, mesh_of, union_distance
from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp, so3_log

ARM = (
    Part("upper", None, (0, 0, 0), (RoundCone((0, 0, 0), (1, 0, 0), 0.15, 0.15),)),
    Part("lower", "upper", (1, 0, 0), (RoundCone((1, 0, 0), (2, 0, 0), 0.15, 0.15),)),
    Part("tip", "lower", (2, 0, 0), (RoundCone((2.1, 0, 0), (2.4, 0, 0), 0.1, 0.1),)),
)


@pytest.fixture(scope="module")
def bending():
    return bending_figure(ARM, spacing=0.08, blend=0.03, softness=0.05)


@pytest.fixture(scope="module")
def jointed():
    return jointed_figure(ARM, spacing=0.08)


def turns(*angles):
    vectors = torch.zeros(len(angles), 3, dtype=torch.float64)
    vectors[:, 2] = torch.tensor(angles)
    return so3_exp(vectors)


def test_without_turns_nothing_moves(bending, jointed):
    for figure in (bending, jointed):
        transforms = figure.transforms(turns(0.0, 0.0, 0.0))
        torch.testing.assert_close(figure.vertices(transforms), figure.mesh.vertices)
        torch.testing.assert_close(figure.joint_positions(transforms), figure.joints[1:])


def test_parts_carry_what_hangs_on_them(jointed):
    quarter = math.pi / 2
    transforms = jointed.transforms(turns(quarter, quarter, 0.0))
    # The upper arm goes along y, the lower one back along -x from (0, 1, 0).
    expected = torch.tensor([[0.0, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(jointed.joint_positions(transforms), expected)


def test_the_base_moves_all(bending):
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([1.0, 2, 3])
    moved = bending.vertices(bending.transforms(turns(0.0, 0.4, 0.0), base))
    still = bending.vertices(bending.transforms(turns(0.0, 0.4, 0.0)))
    torch.testing.assert_close(moved, still + base[:3, 3])


def test_a_batch_is_a_loop(bending):
    rotations = torch.stack([turns(0.1, 0.2, 0.3), turns(-0.4, 0.5, 0.0)])
    batch = bending.vertices(bending.transforms(rotations))
    for one, rotation in zip(batch, rotations, strict=True):
        torch.testing.assert_close(one, bending.vertices(bending.transforms(rotation)))


def test_skins_bend_smoothly_and_pieces_stay_rigid(bending, jointed):
    assert 0.3 < float(bending.weights.amax(-1).min()) < 0.7
    torch.testing.assert_close(bending.weights.sum(-1), torch.ones(len(bending.weights), dtype=torch.float64))
    assert set(jointed.weights.unique().tolist()) == {0.0, 1.0}
    pose = jointed.vertices(jointed.transforms(turns(0.3, -0.7, 0.9)))
    edges = jointed.mesh.faces[:, :2]
    for vertices in (jointed.mesh.vertices, pose):
        lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=-1)
        rest = (jointed.mesh.vertices[edges[:, 0]] - jointed.mesh.vertices[edges[:, 1]]).norm(dim=-1)
        torch.testing.assert_close(lengths, rest)


def test_names_lead_to_numbers(jointed):
    assert jointed.index("tip") == 2
    with pytest.raises(InputError, match="must have a part called 'hand', got upper, lower, tip"):
        jointed.index("hand")


def test_trees_out_of_order_and_bad_numbers_are_refused():
    with pytest.raises(InputError, match="different names"):
        jointed_figure((ARM[0], ARM[0]), spacing=0.1)
    with pytest.raises(InputError, match="parents come first"):
        bending_figure((ARM[1], ARM[0]), spacing=0.1, blend=0.0, softness=0.1)
    with pytest.raises(InputError, match="softness"):
        bending_figure(ARM, spacing=0.1, blend=0.0, softness=0.0)
    with pytest.raises(InputError, match="spacing"):
        jointed_figure(ARM, spacing=0.0)


BALL = RoundCone((0.1, 0.2, 0.3), (0.1, 0.2, 0.3), 0.5, 0.5)


def test_a_cone_without_length_is_a_ball():
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = (points - points.new_tensor([0.1, 0.2, 0.3])).norm(dim=-1) - 0.5
    torch.testing.assert_close(BALL.distance(points), expected)


def test_a_cone_of_one_radius_is_a_capsule():
    solid = RoundCone((0, 0, 0), (0, 0, 2), 0.3, 0.3)
    points = torch.tensor([[1.0, 0, 1], [0, 0, 3], [0, 0.1, 0.5]])
    torch.testing.assert_close(solid.distance(points), torch.tensor([0.7, 0.7, -0.2]))


def test_box_distances_beside_an_edge_and_inside():
    box = RoundBox((1, 0, 0), (0.5, 0.4, 0.3), 0.1)
    points = torch.tensor([[1.0, 0, 0], [2.0, 0, 0], [1.8, 0.7, 0]])
    rounded = math.hypot(0.4, 0.4) - 0.1
    torch.testing.assert_close(box.distance(points), torch.tensor([-0.3, 0.5, rounded]))


@pytest.mark.parametrize(
    "solid", [RoundCone((0, 0, 0), (0.2, 0.5, -0.1), 0.2, 0.1), RoundBox((0, 1, 2), (1, 2, 3), 0.2)]
)
def test_solids_lie_in_their_bounds(solid):
    lower, upper = (torch.tensor(corner) for corner in solid.bounds())
    draws = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    points = lower - 1 + draws * (upper - lower + 2)
    inside = points[solid.distance(points) <= 0]
    assert len(inside) > 10
    assert bool(((inside >= lower - 1e-6) & (inside <= upper + 1e-6)).all())


def test_a_blended_union_rounds_the_seam_and_leaves_the_rest():
    cones = [RoundCone((0, 0, 0), (1, 0, 0), 0.2, 0.2), RoundCone((1, 0, 0), (1, 1, 0), 0.2, 0.2)]
    points = torch.tensor([[0.8, 0.2, 0.0], [-0.2, 0.0, 0.0]], dtype=torch.float64)
    sharp, smooth = union_distance(cones, points, 0.0), union_distance(cones, points, 0.02)
    torch.testing.assert_close(sharp[0] - smooth[0], torch.tensor(0.02 * math.log(2), dtype=torch.float64))
    torch.testing.assert_close(sharp[1], smooth[1], atol=1e-6, rtol=0)


def test_meshes_are_closed_and_lie_on_the_surface():
    mesh = mesh_of([BALL], 0.1)
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    assert set(sides.unique(dim=0, return_counts=True)[1].tolist()) == {2}
    assert float(BALL.distance(mesh.vertices).abs().max()) < 0.01
    outwards = mesh.vertices[mesh.faces].mean(1) - mesh.vertices.new_tensor([0.1, 0.2, 0.3])
    assert bool(((outwards * mesh.face_normals()).sum(-1) > 0).all())


COARSE = 0.04


@pytest.fixture(scope="module", params=[person, quadruped])
def body(request):
    return request.param(spacing=COARSE)


def test_bodies_are_one_closed_surface(body):
    sides = body.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    edges, counts = sides.unique(dim=0, return_counts=True)
    assert set(counts.tolist()) == {2}
    label = torch.arange(body.mesh.num_vertices)
    for _ in range(1000):
        least = torch.minimum(label[edges[:, 0]], label[edges[:, 1]])
        new = label.scatter_reduce(0, edges[:, 0], least, "amin").scatter_reduce(0, edges[:, 1], least, "amin")
        new = new[new]
        if torch.equal(new, label):
            break
        label = new
    assert label.unique().numel() == 1
    # Euler's formula for a sphere: nothing fused that should hang free.
    assert body.mesh.num_vertices - len(edges) + body.mesh.num_faces == 2


def test_every_part_has_skin_of_its_own(body):
    assert torch.bincount(body.weights.argmax(-1), minlength=body.num_parts).min() > 10
    assert bool((body.weights.amax(0) > 0.9).all())


def test_bodies_are_mirror_images_of_themselves(body):
    for index, name in enumerate(body.part_names):
        if "left" in name:
            other = body.joints[body.index(name.replace("left", "right"))]
            torch.testing.assert_close(body.joints[index] * other.new_tensor([-1.0, 1, 1]), other)


def test_a_person_has_the_height_of_one():
    lower, upper = person(spacing=COARSE).mesh.bounds()
    assert 1.7 < float(upper[1] - lower[1]) < 1.8
    assert abs(float(lower[1])) < 0.03


def test_proportions_change_what_they_name():
    plain = person(spacing=COARSE)
    long_legs, big = person(Proportions(legs=1.2), spacing=COARSE), person(Proportions(size=2.0), spacing=COARSE)
    thigh, shin = plain.index("left thigh"), plain.index("left shin")
    bone = (plain.joints[thigh] - plain.joints[shin]).norm()
    torch.testing.assert_close((long_legs.joints[thigh] - long_legs.joints[shin]).norm(), 1.2 * bone)
    torch.testing.assert_close(big.mesh.vertices, 2 * plain.mesh.vertices)
    torch.testing.assert_close(big.joints, 2 * plain.joints)


def test_random_proportions_follow_the_generator_and_their_spread():
    first = Proportions.random(torch.Generator().manual_seed(3), 0.2)
    assert first == Proportions.random(torch.Generator().manual_seed(3), 0.2)
    assert first != Proportions.random(torch.Generator().manual_seed(4), 0.2)
    assert Proportions.random() == Proportions.random(torch.Generator().manual_seed(0))
    assert all(abs(math.log(value)) <= math.log(1.2) for value in vars(first).values())
    assert Proportions.random(spread=0.0) == Proportions()


def test_bad_proportions_are_named():
    with pytest.raises(InputError, match="belly"):
        Proportions(belly=0.0)


PHASE = torch.arange(0, 5, 0.02, dtype=torch.float64)


@pytest.fixture(scope="module")
def walker():
    return person(spacing=0.05)


@pytest.fixture(scope="module")
def animal():
    return quadruped(spacing=0.05)


def height(figure, transforms, part):
    """The lowest vertex of a part over time."""
    own = figure.weights.argmax(-1) == figure.index(part)
    return figure.vertices(transforms)[:, own, 1].amin(-1)


def test_legs_take_turns_and_knees_bend_one_way_only(walker):
    rotations, _ = person_walk(walker, PHASE)
    swings = so3_log(rotations[:, [walker.index("left thigh"), walker.index("right thigh")]])[..., 0]
    assert float(torch.corrcoef(swings.mT)[0, 1]) < -0.8
    knees = so3_log(rotations[:, walker.index("left shin")])[:, 0].rad2deg()
    assert float(knees.min()) > 0
    assert 45 < float(knees.max()) < 75
    elbows = so3_log(rotations[:, walker.index("right forearm")])[:, 0].rad2deg()
    assert float(elbows.max()) < 0


def test_arms_swing_against_the_legs(walker):
    rotations, _ = person_walk(walker, PHASE)
    transforms = walker.transforms(rotations)
    ahead = transforms[:, :, :3, :3] @ torch.tensor([0.0, -1, 0], dtype=torch.float64)
    arm, leg = (ahead[:, walker.index(f"left {part}"), 2] for part in ("upper arm", "thigh"))
    assert float(torch.corrcoef(torch.stack([arm, leg]))[0, 1]) < -0.8


def test_a_foot_is_near_the_ground_at_every_time(walker):
    rotations, rise = person_walk(walker, PHASE)
    transforms = walker.transforms(rotations)
    feet = torch.stack([height(walker, transforms, f"{side} foot") + rise for side in ("left", "right")])
    lowest = feet.amin(0)
    assert float(lowest.std()) < 0.03
    # Each swings through the air by turns.
    assert float((feet - lowest).amax(1).min()) > 0.05


def test_walks_are_smooth_and_repeat_only_under_a_seed(walker):
    first = person_walk(walker, PHASE, torch.Generator().manual_seed(1))
    torch.testing.assert_close(first, person_walk(walker, PHASE, torch.Generator().manual_seed(1)), rtol=0, atol=0)
    assert not torch.allclose(first[0], person_walk(walker, PHASE, torch.Generator().manual_seed(2))[0])
    steps = (first[0][1:] - first[0][:-1]).flatten(1).norm(dim=-1)
    # 0.02 cycles turn no joint by more than 10 degrees.
    assert float(steps.max()) < 0.5
    one_cycle = 50
    assert not torch.allclose(first[0][0], first[0][one_cycle], atol=1e-3)


@pytest.mark.parametrize("gait", list(GAITS))
def test_animals_stand_on_at_least_one_foot(animal, gait):
    rotations, rise = animal_walk(animal, PHASE, gait)
    transforms = animal.transforms(rotations)
    feet = torch.stack([height(animal, transforms, f"{leg} foot") + rise for leg in GAITS[gait]])
    assert float(feet.amin(0).max()) < 0.15
    assert float((feet.amax(1) - feet.amin(1)).min()) > 0.05


def test_gaits_differ_and_know_their_figures(walker, animal):
    assert not torch.allclose(animal_walk(animal, PHASE, "walk")[0], animal_walk(animal, PHASE, "trot")[0])
    with pytest.raises(InputError, match="gait must be one of walk, trot, gallop"):
        animal_walk(animal, PHASE, "swim")
    with pytest.raises(InputError, match="must have a part called 'pelvis'"):
        person_walk(animal, PHASE)
    with pytest.raises(InputError, match="must have a part called 'chest'"):
        animal_walk(walker, PHASE)
