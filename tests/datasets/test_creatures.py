"""Made-up creatures: their truth against their surfaces, and frames that share nothing."""

import pytest
import torch

from torchreg.datasets import creatures


def euler(mesh):
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    return mesh.num_vertices - len(edges.sort(-1).values.unique(dim=0)) + mesh.num_faces


@pytest.mark.parametrize("form", [creatures.STARFISH, creatures.OCTOPUS], ids=["starfish", "octopus"])
def test_arms_end_on_the_surface_and_lie_inside(form):
    sequence = creatures.creature_sequence(form, 2, resolution=64, dtype=torch.float64)
    assert sequence.topology == "(" + "()" * form.num_arms + ")"
    for mesh, tips, curves in zip(sequence.meshes, sequence.tips, sequence.curves, strict=True):
        assert float(torch.cdist(tips, mesh.vertices).amin(-1).max()) < 0.04
        depth = torch.cdist(curves[:, 5:-1], mesh.vertices).amin(-1)
        # As far from the surface as the arm is thick, or farther in the body.
        assert bool((depth > sequence.radii[:, 5:-1] - 0.04).all())
        assert euler(mesh) == 2


@pytest.mark.parametrize("touching", ["flanks", "tips"])
def test_frames_are_meshed_anew_and_arms_that_touch_are_merged_in_the_frames_marked(touching):
    sequence = creatures.creature_sequence(creatures.STARFISH, 9, touching=touching, resolution=48)
    assert len({mesh.num_vertices for mesh in sequence.meshes}) > 6
    # Nothing is stretched: the axes keep their lengths.
    lengths = (sequence.curves[:, :, 1:] - sequence.curves[:, :, :-1]).norm(dim=-1).sum(-1)
    torch.testing.assert_close(lengths, lengths[:1].expand_as(lengths), rtol=3e-3, atol=0)
    assert sequence.touching.tolist() == [False] * 4 + [True] * 2 + [False] * 3
    outer = slice(24, None)  # outside of the body
    apart = torch.cdist(sequence.curves[:, 0, outer], sequence.curves[:, 1, outer])
    gap = (apart - sequence.radii[0, outer, None] - sequence.radii[1, outer]).amin((1, 2))
    assert bool(((gap < 0) == sequence.touching).all())
    if touching == "tips":  # the arms close a ring
        assert [euler(mesh) <= 0 for mesh in sequence.meshes] == sequence.touching.tolist()
    else:
        middle = sequence.tips[sequence.touching]
        assert float((middle[:, 0] - middle[:, 1]).norm(dim=-1).min()) > 2.5 * creatures.STARFISH.end


def test_noise_roughens_the_surface_without_moving_it():
    smooth, rough = (
        creatures.creature_sequence(creatures.STARFISH, 1, resolution=48, noise=noise) for noise in (0.0, 0.5)
    )
    assert torch.equal(smooth.tips, rough.tips)
    distance = torch.cdist(rough.meshes[0].vertices, smooth.meshes[0].vertices).amin(-1)
    assert 0.005 < float(distance.mean()) < 0.05
