"""The mirror symmetry of a body: found from single frames, and what poses say of names where there is one."""

import pytest
import torch

from experiments.made_up.bodies import person
from experiments.made_up.gaits import person_tucks
from torchreg.spines.names.body_mirror import _exchanges, _images, find_mirror
from torchreg.spines.names.name_chain import name_over_time
from torchreg.spines.names.name_model import _background
from torchreg.spines.names.tip_features import TipFeatures, TipObservations


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_frame(count, seed=0):
    """A frame of random distances, volumes that change their sign as they must, and limbs."""
    distances, volumes = random(count, count, seed=seed).abs(), random(count, count, count, seed=seed + 1)
    for first, second in ((0, 1), (1, 2), (0, 1)):
        volumes = volumes - volumes.transpose(first, second)
    order = torch.stack([volumes.permute(*p) for p in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]).sum(0)
    return TipObservations(
        random(count, 8, 3), distances + distances.mT, order - order.transpose(0, 1), random(count, 3)
    )


@pytest.mark.parametrize(("count", "number"), [(3, 4), (5, 26), (6, 76)])
def test_exchanges_are_all_permutations_that_undo_themselves(count, number):
    rows = torch.tensor(list(_exchanges(list(range(count)), 0)))
    assert rows[0].tolist() == list(range(count))
    assert len(rows.unique(dim=0)) == len(rows) == number
    assert bool((rows.gather(1, rows) == torch.arange(count)).all())


def test_a_mirror_gives_the_features_of_the_mirrored_frame_under_exchanged_names():
    frame, kinds = some_frame(5), TipFeatures(5, 3, with_volumes=True)
    names, usual = torch.tensor([[1, 0, 3, 2, 4]]), torch.zeros(10).double()
    columns, signs = _images(kinds, names)
    mirrored = TipObservations(frame.curves, frame.geodesics, -frame.volumes, frame.limbs)
    features = kinds(frame, torch.arange(5)[None], usual)[0]
    torch.testing.assert_close(signs[0] * features[columns[0]], kinds(mirrored, names, usual)[0])


def lifted_legs(num_frames):
    """Frames of somebody who lifts the legs in turn, told by the distances of feet to hands alone; orders of tips.

    Tips are two feet, near each other, two hands and the head.
    """
    wanted = torch.tensor([[0, 1.0, 1.5, 1.55, 1.7], [1.0, 0, 1.55, 1.5, 1.7], [1.5, 1.55, 0, 1.3, 1.0],
                           [1.55, 1.5, 1.3, 0, 1.0], [1.7, 1.7, 1.0, 1.0, 0]]).double()  # fmt: skip
    roots = torch.tensor([[-0.1, 0, 0], [0.1, 0, 0], [-0.2, 0, 0.6], [0.2, 0, 0.6], [0, 0, 0.7]]).double()
    ends = torch.tensor([[-0.02, 0, -0.8], [0.02, 0, -0.8], [-0.5, 0, 0.1], [0.5, 0, 0.1], [0, 0, 0.9]]).double()
    share, frames, orders = torch.linspace(0, 1, 8).double()[:, None], [], []
    for number in range(num_frames):
        phase = torch.tensor(torch.pi * number / 4).double()
        lift = torch.stack((phase.sin().clamp_min(0), (-phase.sin()).clamp_min(0), *torch.zeros(3).double()))
        tips = ends + torch.stack((torch.zeros(5).double(), 0.3 * lift, 0.6 * lift), 1)
        curves = tips[:, None] + share * (roots - tips)[:, None]
        noise = 0.003 * random(5, 5, seed=number) - 0.15 * lift
        limbs = torch.stack((wanted.mean(1) - 0.3 * lift, torch.tensor([-2.0, -2, -2.5, -2.5, -1.5]).double()), 1)
        order = torch.randperm(5, generator=torch.Generator().manual_seed(number))
        distances = (wanted + noise + noise.mT).fill_diagonal_(0)[order][:, order]
        volumes = torch.zeros(5, 5, 5).double()
        frames.append(TipObservations(curves[order], distances, volumes, (limbs + 0.01 * random(5, 2))[order]))
        orders.append(order)
    return frames, orders


def test_legs_that_are_lifted_in_turn_keep_their_names():
    frames, orders = lifted_legs(9)
    found = name_over_time(frames, 2, torch.arange(5))
    names = torch.stack([order[row] for order, row in zip(orders, found.labels, strict=True)])
    assert bool((names == orders[2]).all())


def test_the_mirror_of_a_body_is_found_and_limbs_that_are_all_alike_have_none():
    frames, orders = lifted_legs(9)
    names = torch.stack([order.argsort() for order in orders])
    kinds = TipFeatures(5, 2, with_volumes=False)
    _, background = _background(kinds, frames)
    names[3, :2] = names[3, [1, 0]].clone()  # a wrong name does not matter
    names[4, 2] = -1
    assert find_mirror(kinds, background, frames, names).names.tolist() == [1, 0, 3, 2, 4]
    alike = [TipObservations(frame.curves, 1 + 0.02 * (d := random(5, 5, seed=k)) + 0.02 * d.mT, frame.volumes,
                             1 + 0.02 * random(5, 2, seed=k)) for k, frame in enumerate(frames)]  # fmt: skip
    assert find_mirror(kinds, _background(kinds, alike)[1], alike, names) is None


def test_knees_and_forearms_of_a_person_are_tucked_in_by_turns_and_in_the_mirror():
    figure = person(spacing=0.08)
    turns, _ = person_tucks(figure, torch.tensor([0.0, 0.25, 0.5, 0.75]))
    joints = figure.joint_positions(figure.transforms(turns))
    names = [name for name in figure.part_names if name != figure.part_names[0]]
    feet = joints[:, [names.index("left foot"), names.index("right foot")], 1]
    assert bool((feet[[0, 2]].diff(dim=1).abs() < 0.02).all())
    assert float(feet[1, 0] - feet[1, 1]) > 0.3
    assert float(feet[3, 1] - feet[3, 0]) > 0.3
