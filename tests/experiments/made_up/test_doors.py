"""All made-up data of the experiments: the same again under a seed, others under another, and bad arguments by name."""

import math

import pytest
import torch

from experiments.made_up.bodies import Proportions, person, quadruped
from experiments.made_up.gaits import animal_walk, person_tucks, person_walk
from experiments.made_up.moving_labels import moving_labels
from experiments.made_up.pictures import PictureStyle, camera_ring, render, stereo_cameras, value_noise
from experiments.made_up.plants import PlantForm, growing_plant
from experiments.made_up.shape_sequences import other_hand, rig_sequence
from experiments.made_up.toys import random_toy
from experiments.made_up.videos import shape_video
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import unit_sphere
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import sample_skin

HAND = Hand().requires_grad_(False)
REST, PHASE, SMALL = HAND.rest_pose(), torch.linspace(0, 2, 30), DepthScanner(num_points=800)
MAN, BEAST = person(spacing=0.08), quadruped(spacing=0.08)
STYLE, PAIR = PictureStyle(supersampling=1), stereo_cameras(width=40, height=30, focal=50.0)
STILL = torch.zeros(HAND.num_dofs)


def generated(seed):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    "make",
    [
        lambda seed: torch.tensor([*vars(Proportions.random(generated(seed))).values()]),
        lambda seed: person_walk(MAN, PHASE, generated(seed))[0],
        lambda seed: person_tucks(MAN, PHASE, generated(seed))[0],
        lambda seed: animal_walk(BEAST, PHASE, generator=generated(seed))[0],
        lambda seed: walking_figure(2, seed, scanner=SMALL)[1].points,
        lambda seed: random_toy(generated(seed), spacing=0.03).figure.mesh.vertices,
        lambda seed: growing_plant(PlantForm(2, 0), 2, resolution=24, seed=seed).tips,
        lambda seed: other_hand(generated(seed)).bone_lengths,
        lambda seed: rig_sequence(HAND, STILL, 1, num_points=40, seed=seed)[0].points,
        lambda seed: next(shape_video(HAND, REST[None] + PLACE, PAIR, style=STYLE, seed=seed))[0].image,
    ],
)
def test_seeds_repeat_and_differ(make):
    first, again, other = make(0), make(0), make(1)
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


PLACE = torch.nn.functional.pad(torch.tensor([0.6]), (2, HAND.num_dofs - 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Proportions(belly=0.0), "belly"),
        (lambda: animal_walk(BEAST, PHASE, "swim"), "gait must be one of walk, trot, gallop"),
        (lambda: person_walk(BEAST, PHASE), "must have a part called 'pelvis'"),
        (lambda: animal_walk(MAN, PHASE), "must have a part called 'chest'"),
        (lambda: walking_figure(1), "frames"),
        (lambda: walking_animal(3, cycles_per_frame=0.0), "cycles_per_frame"),
        (lambda: random_toy(num_parts=10), "num_parts must be at most 9"),
        (lambda: moving_labels(jointed_toy(2).pair(0, 1), -1.0), "tolerance"),
        (lambda: PlantForm(num_leaves=1), "num_leaves must be at least 2"),
        (lambda: PlantForm(sway=-1.0), "sway must be zero or positive"),
        (lambda: growing_plant(num_frames=1), "num_frames must be at least 2"),
        (lambda: growing_plant(noise=-1.0), "noise must be zero or positive"),
        (lambda: growing_plant(resolution=4), "resolution must be at least 16"),
        (lambda: other_hand(scale=-0.1), "scale must be zero or positive"),
        (lambda: rig_sequence(HAND, torch.zeros(3)), "full_bend must have shape"),
        (lambda: rig_sequence(HAND, STILL + 1), "full_bend must be zero for the six"),
        (lambda: rig_sequence(HAND, STILL, 0), "num_frames must be at least 1, got 0"),
        (lambda: rig_sequence(HAND, STILL, fps=0.0), "fps must be positive"),
        (lambda: rig_sequence(HAND, STILL, turn=-1.0), "turn must be zero or positive"),
        (lambda: rig_sequence(HAND, STILL, distance=0.0), "distance must be positive"),
        (lambda: rig_sequence(HAND, STILL, facing=(1.0, 2.0)), r"facing must have shape \(3\)"),
        (lambda: rig_sequence(HAND, STILL, facing="front"), "facing must be"),
        (lambda: PictureStyle(noise=-1.0), "noise must be zero or positive"),
        (lambda: PictureStyle(supersampling=0), "supersampling must be at least 1"),
        (lambda: PictureStyle(wall=0.0), "wall must be positive"),
        (lambda: render(unit_sphere(1), PAIR.left, torch.zeros(3, 3)), "rest must have shape"),
        (lambda: camera_ring([0, 0, 0], 1.0, 1), "count must be at least 2"),
        (lambda: value_noise(torch.zeros(2, 3), 0.0), "wavelength must be positive"),
        (lambda: next(shape_video(HAND, REST[None], PAIR, skin=sample_skin(HAND, 50))), "skin must have faces"),
        (lambda: next(shape_video(HAND, REST, PAIR)), "poses must have shape"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises((InputError, InputTypeError), match=message):
        call()


def test_another_hand_is_off_part_by_part():
    plain, other, same = Hand(), other_hand(generated(1), 0.08, nu=0.0025), other_hand(scale=0.0, side="left")
    with torch.no_grad():
        ratio = other.bone_lengths / plain.bone_lengths
        torch.testing.assert_close(torch.maximum(ratio, 1 / ratio), torch.full_like(ratio, 1.08), atol=1e-4, rtol=0)
        assert float(ratio.min()) < 1 < float(ratio.max())
        assert torch.equal(same.bone_lengths, plain.bone_lengths)
    assert (other.nu, same.side) == (0.0025, "left")


def test_a_shape_bends_and_turns_before_one_camera():
    bend = STILL.clone()
    bend[HAND.dof_names.index("index_pip_flexion")] = math.radians(60)
    clouds = rig_sequence(HAND, bend, facing=(0.0, 0.0, math.pi), num_points=40, distance=0.9)
    poses = torch.stack([cloud.pose for cloud in clouds])
    assert len(clouds) == 60
    assert all(len(cloud.points) == 50 and int(cloud.inliers.sum()) == 40 for cloud in clouds)
    torch.testing.assert_close(poses[25, 6:], REST[6:] + bend[6:])
    assert bool((poses[:, 6:] - REST[6:] <= bend[6:] + 1e-6).all())
    middle = HAND.part_transforms(poses)[..., :3, 3].mean(1)
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.0, 0.9]).expand(60, 3))
    # A turn to each side by 40 degrees before the facing: rotation vectors between the first and the widest.
    turned = HAND.part_transforms(poses)[:, 0, :3, :3]
    cosine = (turned @ turned[0].mT).diagonal(dim1=-2, dim2=-1).sum(-1) / 2 - 0.5
    assert float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max()) == pytest.approx(40, abs=0.1)
