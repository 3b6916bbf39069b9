"""Made-up creatures: their truth against their surfaces, frames that share nothing, and the same again under a seed."""

import pytest
import torch

from torchreg.datasets.creatures import OCTOPUS, STARFISH, CreatureForm, creature_sequence
from torchreg.errors import InputError
from torchreg.geometry.neighbors import nearest_neighbor


@pytest.fixture(scope="module")
def starfish():
    return creature_sequence(STARFISH, 9, touching="flanks", resolution=48, dtype=torch.float64)


def euler(mesh):
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    return mesh.num_vertices - len(edges.sort(-1).values.unique(dim=0)) + mesh.num_faces


@pytest.mark.parametrize("form", [STARFISH, OCTOPUS], ids=["starfish", "octopus"])
def test_arms_end_on_the_surface_and_lie_inside(form):
    sequence = creature_sequence(form, 2, resolution=64, dtype=torch.float64)
    assert sequence.tips.shape == (2, form.num_arms, 3)
    assert sequence.topology == "(" + "()" * form.num_arms + ")"
    for mesh, tips, curves in zip(sequence.meshes, sequence.tips, sequence.curves, strict=True):
        assert float(nearest_neighbor(tips, mesh.vertices)[1].max()) < 0.04
        depth = nearest_neighbor(curves[:, 5:-1].flatten(0, 1), mesh.vertices)[1].reshape(form.num_arms, -1)
        # As far from the surface as the arm is thick, or farther in the body.
        assert bool((depth > sequence.radii[:, 5:-1] - 0.04).all())
        assert euler(mesh) == 2


def test_every_frame_is_meshed_anew_and_moves(starfish):
    counts = [mesh.num_vertices for mesh in starfish.meshes]
    assert len(set(counts)) > 6
    moved = (starfish.tips[1:] - starfish.tips[:-1]).norm(dim=-1)
    assert float(moved.min()) > 0
    assert float(moved.max()) < 0.5
    # Nothing is stretched: the axes keep their lengths.
    lengths = (starfish.curves[:, :, 1:] - starfish.curves[:, :, :-1]).norm(dim=-1).sum(-1)
    torch.testing.assert_close(lengths, lengths[:1].expand_as(lengths), rtol=3e-3, atol=0)


@pytest.mark.parametrize("touching", ["flanks", "tips"])
def test_arms_that_touch_are_merged_in_the_frames_marked(touching):
    sequence = creature_sequence(STARFISH, 9, touching=touching, resolution=48)
    assert sequence.touching.tolist() == [False] * 4 + [True] * 2 + [False] * 3
    outer = slice(24, None)  # outside of the body
    apart = torch.cdist(sequence.curves[:, 0, outer], sequence.curves[:, 1, outer])
    gap = (apart - sequence.radii[0, outer, None] - sequence.radii[1, outer]).amin((1, 2))
    assert bool(((gap < 0) == sequence.touching).all())
    if touching == "tips":  # the arms close a ring
        assert [euler(mesh) <= 0 for mesh in sequence.meshes] == sequence.touching.tolist()


def test_the_tips_of_touching_flanks_stay_apart(starfish):
    middle = starfish.tips[starfish.touching]
    assert float((middle[:, 0] - middle[:, 1]).norm(dim=-1).min()) > 2.5 * STARFISH.end


def test_noise_roughens_the_surface_without_moving_it():
    smooth = creature_sequence(STARFISH, 1, resolution=48)
    rough = creature_sequence(STARFISH, 1, resolution=48, noise=0.5)
    assert torch.equal(smooth.tips, rough.tips)
    distance = nearest_neighbor(rough.meshes[0].vertices, smooth.meshes[0].vertices)[1]
    assert 0.005 < float(distance.mean()) < 0.05


def test_seeds_repeat_and_differ():
    first, again, other = (creature_sequence(STARFISH, 2, resolution=32, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.meshes[1].vertices, again.meshes[1].vertices)
    assert first.meshes[1].num_vertices != other.meshes[1].num_vertices


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: creature_sequence(num_frames=0), "num_frames must be at least 1"),
        (lambda: creature_sequence(touching="all"), "touching must be one of none, flanks, tips"),
        (lambda: creature_sequence(noise=-1.0), "noise must be zero or positive"),
        (lambda: creature_sequence(resolution=4), "resolution must be at least 16"),
        (lambda: CreatureForm(2, 0.3, 0.1, 0.1, 0.0, 0.0), "num_arms must be at least 3"),
        (lambda: CreatureForm(5, 0.3, 0.0, 0.1, 0.0, 0.0), "root must be positive"),
        (lambda: CreatureForm(5, 0.3, 0.1, 0.1, -0.1, 0.0), "sway must be zero or positive"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
