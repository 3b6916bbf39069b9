import math

import pytest
import torch

from torchreg.datasets.bodies import Proportions, person, quadruped
from torchreg.errors import InputError

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
