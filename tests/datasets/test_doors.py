"""All made-up data of the package: the same again under a seed, others under another, and bad arguments by name."""

from functools import partial

import pytest
import torch

import torchreg as tr
from torchreg.datasets import creatures, depth_scanner, figures, scan_sequences, sequences, solids, stereo, toys
from torchreg.datasets import hand as made

SMALL = stereo.StereoView(focal=300.0, width=320, height=240)
HAND = tr.Hand().requires_grad_(False)
REST, POSES = HAND.rest_pose(), made.hand_motion(HAND, num_frames=1, distance=0.6)
TOY = toys.robot(spacing=0.03)
STUCK = toys.Toy(TOY.figure, TOY.parts, (toys.Hinge("left upper arm", (0, 0, 1), -0.85, -0.8),))
BALL, AWAY = (solids.mesh_of([solids.ball((x, 0.05, 3), 0.5)], 0.1) for x in (0.1, 5))
SCANNER = depth_scanner.DepthScanner()
PARTS = [
    figures.Part(name, parent, (0, 0, 0), (solids.ball((0, 0, 0), 1.0),)) for name, parent in (("a", None), ("b", "a"))
]


def generated(seed):
    return torch.Generator().manual_seed(seed)


def flat(value):
    """Return all tensors in what a generator returned."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, tr.RangeScan):
        return [value.points]
    values = value if isinstance(value, (list, tuple)) else vars(value).values()
    return [tensor for part in values if not isinstance(part, (str, int)) for tensor in flat(part)]


@pytest.mark.parametrize(
    "make",
    [
        lambda seed, hand, skin: made.make_hand_cloud(hand, REST, skin=skin, generator=generated(seed)),
        lambda seed, hand, skin: made.random_hand_pose(hand, generated(seed)),
        lambda seed, hand, skin: made.hand_motion(hand, num_frames=3, seed=seed),
        lambda seed, hand, skin: sequences.hand_sequence(
            "fast", 1, shape=hand, skin=skin, stereo=SMALL, num_points=50, seed=seed
        ),
        lambda seed, hand, skin: sequences.range_clouds(hand, POSES, skin=skin, num_points=50, seed=seed),
        lambda seed, hand, skin: creatures.creature_sequence(num_frames=1, resolution=24, seed=seed).meshes[0].vertices,
        lambda seed, hand, skin: list(scan_sequences.jointed_toy(2, seed, toy=TOY)),
        lambda seed, hand, skin: TOY.random_motion(2, generator=generated(seed)),
    ],
)
def test_seeds_repeat_and_differ_and_the_global_generator_is_left_alone(make, skin):
    state = torch.get_rng_state()
    first, again, other = (flat(make(seed, HAND, skin)) for seed in (0, 0, 1))
    assert all(torch.equal(one, same) for one, same in zip(first, again, strict=True))
    assert not all(one.shape == new.shape and torch.equal(one, new) for one, new in zip(first, other, strict=True))
    assert torch.equal(state, torch.get_rng_state())


WALL = tr.TriangleMesh(
    torch.tensor([[-2.0, -2, 0.2], [2, -2, 0.2], [2, 2, 0.2], [-2, 2, 0.2]]), torch.tensor([[0, 2, 1], [0, 3, 2]])
)
CLOUD, MOTION = partial(made.make_hand_cloud, HAND), partial(made.hand_motion, HAND)
STEREO, MESHED = partial(stereo.stereo_clouds, HAND, stereo=SMALL), partial(figures.meshed_figure, spacing=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda skin: CLOUD(REST, skin=skin, num_points=0), "num_points must be at least 1, got 0"),
        (lambda skin: CLOUD(REST, skin=skin, noise=-0.1), "noise must be zero or positive"),
        (lambda skin: CLOUD(REST, skin=skin, outlier_ratio=1.0), "outlier_ratio must be at least 0 and below 1"),
        (lambda skin: CLOUD(REST[None].expand(2, -1), skin=skin), r"pose must have shape \(27,\), got \(2, 27\)"),
        (lambda skin: CLOUD(REST[1:], skin=skin), "pose must have shape"),
        (lambda skin: CLOUD(REST, skin=tr.LinearBlendSkin(HAND, skin.points, skin.weights, REST)), "must have faces"),
        (lambda skin: MOTION(kind="wave"), "kind must be one of bend, rotate"),
        (lambda skin: MOTION(num_frames=0), "num_frames must be at least 1, got 0"),
        (lambda skin: MOTION(fps=0.0), "fps must be positive"),
        (lambda skin: MOTION(bend=1.5), "bend must be between 0 and 1"),
        (lambda skin: MOTION(distance=-1.0), "distance must be positive"),
        (lambda skin: made.random_hand_pose(HAND, bend=-0.1), "bend must be"),
        (lambda skin: made.random_hand_pose(HAND, distance=0.0), "distance must be positive"),
        (lambda skin: sequences.range_clouds(HAND, REST, skin=skin), r"poses must have shape \(T, 27\)"),
        (lambda skin: STEREO(POSES, skin=skin, num_points=0), "num_points must be at least 1, got 0"),
        (lambda skin: STEREO(POSES, skin=skin, outlier_ratio=1.0), "outlier_ratio must be at least 0 and below 1"),
        (lambda skin: STEREO(REST, skin=skin), r"poses must have shape \(T, 27\)"),
        (lambda skin: STEREO(0 * POSES, skin=skin), "beside or behind"),
        (lambda skin: STEREO(POSES, skin=skin, obstacle=WALL), "poses must show the shape to both cameras"),
        *((lambda skin, name=name: stereo.StereoView(**{name: -1}), f"{name} must be") for name in vars(SMALL)),
        (lambda skin: creatures.creature_sequence(num_frames=0), "num_frames must be at least 1"),
        (lambda skin: creatures.creature_sequence(touching="all"), "touching must be one of none, flanks, tips"),
        (lambda skin: creatures.creature_sequence(noise=-1.0), "noise must be zero or positive"),
        (lambda skin: creatures.creature_sequence(resolution=4), "resolution must be at least 16"),
        (lambda skin: creatures.CreatureForm(2, 0.3, 0.1, 0.1, 0.0, 0.0), "num_arms must be at least 3"),
        (lambda skin: creatures.CreatureForm(5, 0.3, 0.0, 0.1, 0.0, 0.0), "root must be positive"),
        (lambda skin: creatures.CreatureForm(5, 0.3, 0.1, 0.1, -0.1, 0.0), "sway must be zero or positive"),
        (lambda skin: depth_scanner.DepthScanner(num_points=1), "num_points"),
        (lambda skin: depth_scanner.DepthScanner(max_slant=2.0), "max_slant"),
        *((lambda skin, n=n: depth_scanner.DepthScanner(**{n: -1}), n) for n in ("noise", "num_holes", "hole_radius")),
        (lambda skin: SCANNER.view(AWAY, 0.4), "sees nothing"),
        (lambda skin: SCANNER.scan(AWAY, SCANNER.view(BALL, 0.4), generated(0), torch.float64), "sees nothing"),
        (lambda skin: scan_sequences.jointed_toy(1, toy=TOY), "frames"),
        (lambda skin: scan_sequences.jointed_toy(3, toy=TOY, turn=-1.0), "turn"),
        (lambda skin: next(scan_sequences.jointed_toy(2, toy=TOY).pairs(0)), "step"),
        (
            lambda skin: scan_sequences.ScanSequence(TOY.figure, torch.eye(4).expand(3, 8, 4, 4), SCANNER, (1, 2)),
            "one num",
        ),
        (lambda skin: TOY.figure.index("wing"), "must have a part called 'wing', got body, head"),
        (lambda skin: TOY.rotations(torch.zeros(1)), "angles must have shape"),
        (lambda skin: TOY.random_motion(0), "frames"),
        (lambda skin: TOY.random_motion(2, -0.1), "step"),
        (lambda skin: STUCK.random_motion(1), "parts ran into each other"),
        (lambda skin: MESHED([PARTS[0], PARTS[0]]), "different names"),
        (lambda skin: MESHED(PARTS[::-1]), "parents come first"),
        (lambda skin: MESHED(PARTS, softness=0.0), "softness"),
        (lambda skin: MESHED(PARTS, spacing=0.0), "spacing"),
        (lambda skin: MESHED(PARTS, blend=-1.0), "blend"),
    ],
)
def test_bad_arguments_are_named(call, message, skin):
    with pytest.raises(tr.errors.InputError, match=message):
        call(skin)
