"""Bad input is answered at the public functions, with an error that names the argument."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.pseudo_labels import label_frames
from torchreg.alignment.rough_poses import PrincipalAxes
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.geometry.skeleton import Skeleton

QUICK = tr.FindPoseConfig(num_candidates=2, num_placed=1, num_searched=1, search_rounds=1)
DESCENT = tr.AlignConfig(search="never", em_steps=1, surface_steps=1)


def align(hand, skin, clouds, mask=None, **options):
    return tr.align(hand, clouds, mask=mask, **({"model_points": skin, "config": DESCENT} | options))


def find_pose(hand, skin, clouds, mask=None, **options):
    options = {"model_points": skin, "config": QUICK, "sources": [PrincipalAxes()]} | options
    return tr.find_pose(hand, clouds, mask=mask, **options)


def initialize(hand, skin, clouds, mask=None, start=None):
    return tr.PoseInitializer(hand, model_points=skin)(clouds, mask, start)


def calibrate(hand, skin, clouds, mask=None, **options):
    return tr.calibrate(hand, clouds, masks=mask, config=tr.CalibrateConfig(align=DESCENT), **options)


FUNCTIONS = [
    (align, "data", "mask"),
    (find_pose, "data", "mask"),
    (initialize, "points", "mask"),
    (calibrate, "frames", "masks"),
]


def clouds_with(value):
    clouds = torch.zeros(2, 20, 3)
    clouds[0, :3, 1] = value
    return clouds


# Every function that takes clouds


@pytest.mark.parametrize(("function", "name", "mask_name"), FUNCTIONS)
@pytest.mark.parametrize(
    ("clouds", "mask", "error", "message"),
    [
        (torch.zeros(0, 5, 3), None, InputError, r"NAME must hold at least one point, got shape \(0, 5, 3\)"),
        (torch.zeros(2, 0, 3), None, InputError, r"NAME must hold at least one point, got shape \(2, 0, 3\)"),
        (torch.zeros(2, 5, 2), None, InputError, r"NAME must have shape \(.*, M, 3\), got \(2, 5, 2\)"),
        (torch.zeros(3), None, InputError, r"NAME must have shape \(.*M, 3\), got \(3,\)"),
        (torch.zeros(2, 5, 3) > 0, None, InputTypeError, r"NAME must hold real numbers, got dtype torch\.bool"),
        (clouds_with(math.nan), None, InputError, "NAME hold 3 points that are not finite; drop them or set .*omit"),
        (clouds_with(math.inf), None, InputError, "NAME hold 3 points that are not finite; drop them or set .*omit"),
        (clouds_with(0), torch.ones(2, 20), InputTypeError, "MASK must be a tensor of bool, False where NAME are"),
        (clouds_with(0), torch.ones(20) > 0, InputError, r"MASK must have shape \(2, 20\) like the NAME, got \(20,\)"),
        (clouds_with(0), torch.ones(2, 20) < 0, InputError, "NAME hold no point that is finite and not masked"),
    ],
)
def test_bad_clouds_and_masks(plain_hand, plain_hand_skin, function, name, mask_name, clouds, mask, error, message):
    message = message.replace("NAME", name).replace("MASK", mask_name)
    with pytest.raises(error, match=message):
        function(plain_hand, plain_hand_skin, clouds, mask)


@pytest.mark.parametrize(("function", "name", "mask_name"), FUNCTIONS[:3])
def test_what_is_no_cloud(plain_hand, plain_hand_skin, function, name, mask_name):
    with pytest.raises(InputTypeError, match=f"{name} must be a tensor or an array of numbers, got str"):
        function(plain_hand, plain_hand_skin, "cloud.ply")
    with pytest.raises(InputTypeError, match=f"{mask_name} must be a tensor of bool"):
        function(plain_hand, plain_hand_skin, torch.zeros(4, 3), [True] * 4)


@pytest.mark.parametrize("function", [align, find_pose, initialize])
def test_a_skin_must_be_of_the_same_shape(plain_hand_skin, function):
    with pytest.raises(InputError, match="model_points is a skin of another shape; build it from the shape"):
        function(tr.Hand(), plain_hand_skin, torch.zeros(4, 3))


@pytest.mark.parametrize("function", [align, find_pose])
@pytest.mark.parametrize("scale", [1000.0, 0.001])
def test_other_units_are_warned_of(plain_hand, plain_hand_skin, function, scale):
    """At the line of the caller; what a pose or a crop may do to the size is not."""
    data = plain_hand_skin.points
    start = {"initial_pose": plain_hand.rest_pose()} if function is align else {}
    with pytest.warns(UnitsWarning, match="times the model's size of .* m: are they in metres") as caught:
        function(plain_hand, plain_hand_skin, scale * data, **start)
    assert [warning.filename for warning in caught] == [__file__]
    # Warnings are errors here: neither of these warns.
    function(plain_hand, plain_hand_skin, 10 * data, **start)
    function(plain_hand, plain_hand_skin, scale * data[:5], **start)


# Single functions


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"initial_pose": torch.zeros(26)}, InputError, r"initial_pose must have shape \(\.\.\., 27\), got \(26,\)"),
        ({"initial_pose": torch.full((27,), math.nan)}, InputError, "initial_pose must be finite"),
        ({"initial_pose": torch.zeros(2, 2, 27)}, InputError, "initial_pose must have one or two dimensions"),
        ({"initial_pose": torch.zeros(3, 27)}, InputError, r"initial_pose must hold one pose per cloud \(2\), got 3"),
        ({"model_points": torch.zeros(4, 2)}, InputError, "model_points given as a tensor need a single initial_pose"),
    ],
)
def test_bad_starts_and_model_points_of_align(plain_hand, plain_hand_skin, options, error, message):
    with pytest.raises(error, match=message):
        align(plain_hand, plain_hand_skin, torch.zeros(2, 20, 3), **options)
    with pytest.raises(InputError, match="points must have shape"):
        align(plain_hand, torch.zeros(4, 2), torch.zeros(20, 3), initial_pose=plain_hand.rest_pose())


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"num_starts": 0}, InputError, "num_starts must be at least 1, got 0"),
        ({"num_starts": 2.0}, InputTypeError, "num_starts must be an integer, got float"),
        ({"model_points": torch.zeros(5, 3)}, InputTypeError, "model_points must be a skin of the shape, .* Tensor"),
        ({"sources": ()}, InputError, "sources must hold at least one source of rough poses, got none"),
    ],
)
def test_bad_arguments_of_find_pose(plain_hand, plain_hand_skin, options, error, message):
    with pytest.raises(error, match=message):
        find_pose(plain_hand, plain_hand_skin, torch.zeros(4, 3), **options)


@pytest.mark.parametrize(
    ("start", "message"),
    [(torch.zeros(3, 27), r"start must have shape \(2, 27\)"), (torch.full((27,), math.nan), "start must be finite")],
)
def test_bad_starts_of_an_initializer(plain_hand, plain_hand_skin, start, message):
    with pytest.raises(InputError, match=message):
        initialize(plain_hand, plain_hand_skin, torch.zeros(2, 20, 3), start=start)


def test_bad_frames_and_poses_of_calibrate(plain_hand):
    box = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
    faces = torch.tensor([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]])
    rig = tr.ArticulatedShape.from_skinned_mesh(box, faces, torch.ones(8, 1), torch.zeros(1, 3), [-1])
    frames, cloud = torch.zeros(2, 20, 3), torch.zeros(5, 3)
    for shape, data, options, error, message in (
        (plain_hand, [], {}, InputError, r"frames must hold at least one point, got shape \(0, 0, 3\)"),
        (plain_hand, torch.zeros(20, 3), {}, InputError, r"frames must have shape \(T, M, 3\), got \(20, 3\)"),
        (plain_hand, [cloud, cloud[0]], {}, InputError, r"frames\[1\] must have shape \(M, 3\)"),
        (plain_hand, ["a.ply"], {}, InputTypeError, r"frames\[0\] must be a tensor or an array of numbers, got str"),
        (plain_hand, [cloud], {"mask": torch.ones(1, 5) > 0}, InputError, "masks go with frames in one tensor"),
        (plain_hand, frames, {"initial_poses": torch.zeros(3, 27)}, InputError, "initial_poses must have shape"),
        (plain_hand, frames, {"initial_poses": torch.zeros(9)}, InputError, "initial_poses must have shape"),
        (plain_hand, frames, {"initial_poses": torch.full((27,), math.nan)}, InputError, "initial_poses must be fin"),
        (rig, frames, {}, InputError, "shape has the surface of a file, whose mesh cannot follow the scales"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            calibrate(shape, None, data, **options)


def test_bad_skeletons_and_labels(plain_hand, plain_hand_skin):
    chain = Skeleton(torch.eye(3)[:2], torch.tensor([[0, 1]]), torch.ones(2))
    single = Skeleton(torch.zeros(1, 3), torch.zeros(0, 2).long(), torch.ones(1))
    initializer = tr.PoseInitializer(plain_hand, model_points=plain_hand_skin)
    for call, error, message in (
        (lambda: tr.SpineLimbs("skeleton"), InputTypeError, "skeleton must be a Skeleton"),
        (lambda: tr.SpineLimbs(single), InputError, "skeleton must have a limb"),
        (lambda: tr.SpineLimbs(chain, 0), InputError, "count must be at least 1"),
        (lambda: next(label_frames(initializer, [], trusted=-1.0)), InputError, "trusted must be zero or positive"),
    ):
        with pytest.raises(error, match=message):
            call()


# Settings


@pytest.mark.parametrize(
    ("config", "options", "error", "message"),
    [
        (tr.AlignConfig, {"search": "often"}, InputError, "search must be one of auto, always, never; got 'often'"),
        (tr.AlignConfig, {"correspondence": "icp"}, InputError, "correspondence must be one of em, softassign"),
        (tr.AlignConfig, {"outlier": "none"}, InputError, "outlier must be one of limit, volume"),
        (tr.AlignConfig, {"nan_policy": "drop"}, InputError, "nan_policy must be one of raise, omit"),
        (tr.AlignConfig, {"upright": (0, 1)}, InputError, "upright must have shape"),
        (tr.AlignConfig, {"upright": (0, 0, 0)}, InputError, "upright must be a direction, got zeros"),
        (tr.FindPoseConfig, {"upright": (0, math.nan, 1)}, InputError, "upright must be finite"),
        (tr.AlignConfig, {"em_steps": 0}, InputError, "em_steps must be at least 1, got 0"),
        (tr.AlignConfig, {"m_steps": 1.5}, InputTypeError, "m_steps must be an integer, got float"),
        (tr.AlignConfig, {"num_candidates": True}, InputTypeError, "num_candidates must be an integer, got bool"),
        (tr.AlignConfig, {"surface_steps": -1}, InputError, "surface_steps must be at least 0, got -1"),
        (tr.AlignConfig, {"sharpness": 0.0}, InputError, "sharpness must be positive and finite"),
        (tr.AlignConfig, {"pose_atol": -1.0}, InputError, "pose_atol must be zero or positive"),
        (tr.AlignConfig, {"debias": math.nan}, InputError, "debias must be zero or positive and finite"),
        (tr.AlignConfig, {"inlier_distance": 0.0}, InputError, "inlier_distance must be positive"),
        (tr.AlignConfig, {"prior_std": -1.0}, InputError, "prior_std must be positive"),
        (tr.FindPoseConfig, {"num_placed": -1}, InputError, "num_placed must be at least 1, got -1"),
        (tr.FindPoseConfig, {"num_searched": 1.5}, InputTypeError, "num_searched must be an integer, got float"),
        (tr.FindPoseConfig, {"num_retries": -1}, InputError, "num_retries must be at least 0, got -1"),
        (tr.FindPoseConfig, {"prior_std": 0.0}, InputError, "prior_std must be positive and finite, got 0.0"),
        (tr.FindPoseConfig, {"nan_policy": "drop"}, InputError, "nan_policy must be one of raise, omit; got 'drop'"),
        (tr.PoseInitializerConfig, {"noise": 0.0}, InputError, "noise must be positive"),
        (tr.PoseInitializerConfig, {"fit_steps": 0}, InputError, "fit_steps must be at least 1"),
        (tr.PoseInitializerConfig, {"chunk": 0}, InputError, "chunk must be at least 1"),
        (tr.CalibrateConfig, {"rounds": 0}, InputError, "rounds must be at least 1, got 0"),
        (tr.CalibrateConfig, {"steps": 2.0}, InputTypeError, "steps must be an integer, got float"),
        (tr.CalibrateConfig, {"size_std": 0.0}, InputError, "size_std must be positive"),
        (tr.CalibrateConfig, {"radius_std": math.inf}, InputError, "radius_std must be positive and finite"),
    ],
)
def test_bad_settings(config, options, error, message):
    with pytest.raises(error, match=message):
        config(**options)
