"""Made-up plants that grow: their truth against their surfaces, and the same again under a seed."""

import pytest
import torch

from experiments.made_up.plants import PlantForm, growing_plant
from torchreg.errors import InputError
from torchreg.geometry.neighbors import nearest_neighbor


@pytest.fixture(scope="module")
def plant():
    return growing_plant(PlantForm(num_leaves=4, num_branchlets=1), 10, resolution=40, dtype=torch.float64)


def test_tips_lie_on_the_surface_as_long_as_organs_live(plant):
    frames = torch.arange(10)[:, None]
    alive = (frames >= plant.births) & (frames <= plant.ends)
    assert torch.equal(alive, ~plant.tips[..., 0].isnan())
    assert int(plant.births.max()) > 0
    assert int(plant.ends.min()) < 9
    for mesh, tips, there in zip(plant.meshes, plant.tips, alive, strict=True):
        assert float(nearest_neighbor(tips[there], mesh.vertices)[1].max()) < 0.05


def test_organs_lengthen(plant):
    grown = plant.tips - plant.tips[:, :1]
    for organ, birth in enumerate(plant.births.tolist()):
        if 0 < birth < 8:
            heights = grown[birth:, organ].norm(dim=-1)
            assert heights[heights.isfinite()][-1] > heights[0]


def test_a_seed_gives_the_same_plant_again():
    small = PlantForm(num_leaves=2, num_branchlets=0)
    first, again, other = (growing_plant(small, 2, resolution=24, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.meshes[1].vertices, again.meshes[1].vertices)
    assert not torch.equal(first.tips, other.tips)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PlantForm(num_leaves=1), "num_leaves must be at least 2"),
        (lambda: PlantForm(sway=-1.0), "sway must be zero or positive"),
        (lambda: growing_plant(num_frames=1), "num_frames must be at least 2"),
        (lambda: growing_plant(noise=-1.0), "noise must be zero or positive"),
        (lambda: growing_plant(resolution=4), "resolution must be at least 16"),
    ],
)
def test_errors_say_what_to_do(call, message):
    with pytest.raises(InputError, match=message):
        call()
