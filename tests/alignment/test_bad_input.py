"""Bad input is answered at the public functions, with an error that names the argument."""

import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import ARM
from torchreg.alignment.pseudo_labels import label_frames
from torchreg.alignment.search.rough_poses import PrincipalAxes

INPUT, TYPE = tr.errors.InputError, tr.errors.InputTypeError
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


NAMES = ("data", "mask"), ("data", "mask"), ("points", "mask"), ("frames", "masks")
FUNCTIONS = [(call, *names) for call, names in zip((align, find_pose, initialize, calibrate), NAMES, strict=True)]


def clouds_with(value):
    clouds = torch.zeros(2, 20, 3)
    clouds[0, :3, 1] = value
    return clouds


@pytest.mark.parametrize(("function", "name", "mask_name"), FUNCTIONS)
@pytest.mark.parametrize(
    ("clouds", "mask", "error", "message"),
    [
        (torch.zeros(0, 5, 3), None, INPUT, r"NAME must hold at least one point, got shape \(0, 5, 3\)"),
        (torch.zeros(2, 0, 3), None, INPUT, r"NAME must hold at least one point, got shape \(2, 0, 3\)"),
        (torch.zeros(2, 5, 2), None, INPUT, r"NAME must have shape \(.*, M, 3\), got \(2, 5, 2\)"),
        (torch.zeros(3), None, INPUT, r"NAME must have shape \(.*M, 3\), got \(3,\)"),
        (torch.zeros(2, 5, 3) > 0, None, TYPE, r"NAME must hold real numbers, got dtype torch\.bool"),
        (clouds_with(math.nan), None, INPUT, "NAME hold 3 points that are not finite; drop them or set .*omit"),
        (clouds_with(math.inf), None, INPUT, "NAME hold 3 points that are not finite; drop them or set .*omit"),
        (clouds_with(0), torch.ones(2, 20), TYPE, "MASK must be a tensor of bool, False where NAME are"),
        (clouds_with(0), torch.ones(20) > 0, INPUT, r"MASK must have shape \(2, 20\) like the NAME, got \(20,\)"),
        (clouds_with(0), torch.ones(2, 20) < 0, INPUT, "NAME hold no point that is finite and not masked"),
    ],
)
def test_bad_clouds_and_masks(plain_hand, plain_hand_skin, function, name, mask_name, clouds, mask, error, message):
    message = message.replace("NAME", name).replace("MASK", mask_name)
    with pytest.raises(error, match=message):
        function(plain_hand, plain_hand_skin, clouds, mask)


@pytest.mark.parametrize(("function", "name", "mask_name"), FUNCTIONS[:3])
def test_what_is_no_cloud_and_no_skin_of_the_shape(plain_hand, plain_hand_skin, function, name, mask_name):
    with pytest.raises(TYPE, match=f"{name} must be a tensor or an array of numbers, got str"):
        function(plain_hand, plain_hand_skin, "cloud.ply")
    with pytest.raises(TYPE, match=f"{mask_name} must be a tensor of bool"):
        function(plain_hand, plain_hand_skin, torch.zeros(4, 3), [True] * 4)
    with pytest.raises(INPUT, match="model_points is a skin of another shape; build it from the shape"):
        function(tr.Hand(), plain_hand_skin, torch.zeros(4, 3))


@pytest.mark.parametrize("function", [align, find_pose])
@pytest.mark.parametrize("scale", [1000.0, 0.001])
def test_other_units_are_warned_of(plain_hand, plain_hand_skin, function, scale):
    """At the line of the caller; what a pose or a crop may do to the size is not."""
    data = plain_hand_skin.points
    start = {"initial_pose": plain_hand.rest_pose()} if function is align else {}
    with pytest.warns(tr.errors.UnitsWarning, match="times the model's size of .* m: are they in metres") as caught:
        function(plain_hand, plain_hand_skin, scale * data, **start)
    assert [warning.filename for warning in caught] == [__file__]
    # Warnings are errors here: neither of these warns.
    function(plain_hand, plain_hand_skin, 10 * data, **start)
    function(plain_hand, plain_hand_skin, scale * data[:5], **start)


CHAIN = tr.Skeleton(torch.eye(3)[:2], torch.tensor([[0, 1]]), torch.ones(2))
POINT = tr.Skeleton(torch.zeros(1, 3), torch.zeros(0, 2).long(), torch.ones(1))
BAD = torch.full((27,), math.nan)
FRAMES, CLOUD, DATA = torch.zeros(2, 20, 3), torch.zeros(5, 3), torch.rand(9, 3, generator=torch.Generator())
CAMERA = tr.Camera(8, 6, (9.0, 9.0, 3.5, 2.5))


def on_links(**options):
    return lambda g: tr.align(g.links, DATA, g.links.rest, **options)


def on_hand(**options):
    return lambda g: align(g.hand, g.skin, FRAMES, **options)


def from_scratch(**options):
    return lambda g: find_pose(g.hand, g.skin, DATA[:4], **options)


def calibrated(data, **options):
    return lambda g: calibrate(g.hand, None, data, **options)


def base(poses, frames=(DATA,)):
    return lambda g: tr.calibrate_base(g.robot, list(frames), poses)


def of_person(shape="person", data=DATA, **options):
    return lambda g: tr.align(getattr(g, shape), data, g.person.rest_pose(), config=DESCENT, **options)


@pytest.fixture(scope="module")
def given(plain_hand, plain_hand_skin, links, person, tmp_path_factory):
    box = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
    faces = torch.tensor([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]])
    rig = tr.ArticulatedShape.from_skinned_mesh(box, faces, torch.ones(8, 1), torch.zeros(1, 3), [-1])
    path = tmp_path_factory.mktemp("robot") / "arm.urdf"
    path.write_text(ARM)
    robot = tr.ArticulatedShape.from_urdf(path, dtype=torch.float64)
    frame = tr.DepthFrame(torch.ones(6, 8), CAMERA)
    plain = person.with_coefficients(torch.zeros(3))
    return SimpleNamespace(
        hand=plain_hand,
        skin=plain_hand_skin,
        links=links,
        person=person,
        rig=rig,
        robot=robot,
        frame=frame,
        plain=plain,
    )


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (on_hand(initial_pose=torch.zeros(26)), INPUT, r"initial_pose must have shape \(\.\.\., 27\), got \(26,\)"),
        (on_hand(initial_pose=BAD), INPUT, "initial_pose must be finite"),
        (on_hand(initial_pose=torch.zeros(2, 2, 27)), INPUT, "initial_pose must have one or two dimensions"),
        (on_hand(initial_pose=torch.zeros(3, 27)), INPUT, r"initial_pose must hold one pose per cloud \(2\), got 3"),
        (on_hand(model_points=CLOUD), INPUT, "model_points given as a tensor need a single initial_pose"),
        (from_scratch(num_starts=0), INPUT, "num_starts must be at least 1, got 0"),
        (from_scratch(num_starts=2.0), TYPE, "num_starts must be an integer, got float"),
        (from_scratch(model_points=CLOUD), TYPE, "model_points must be a skin of the shape, .* Tensor"),
        (from_scratch(sources=()), INPUT, "sources must hold at least one source of rough poses, got none"),
        (lambda g: initialize(g.hand, g.skin, FRAMES, start=torch.zeros(3, 27)), INPUT, r"shape \(2, 27\)"),
        (lambda g: initialize(g.hand, g.skin, FRAMES, start=BAD), INPUT, "start must be finite"),
        (calibrated([]), INPUT, r"frames must hold at least one point, got shape \(0, 0, 3\)"),
        (calibrated(CLOUD), INPUT, r"frames must have shape \(T, M, 3\), got \(5, 3\)"),
        (calibrated([CLOUD, CLOUD[0]]), INPUT, r"frames\[1\] must have shape \(M, 3\)"),
        (calibrated(["a.ply"]), TYPE, r"frames\[0\] must be a tensor or an array of numbers, got str"),
        (calibrated([CLOUD], mask=torch.ones(1, 5) > 0), INPUT, "masks go with frames in one tensor"),
        (calibrated(FRAMES, initial_poses=torch.zeros(3, 27)), INPUT, "initial_poses must have shape"),
        (calibrated(FRAMES, initial_poses=torch.zeros(9)), INPUT, "initial_poses must have shape"),
        (calibrated(FRAMES, initial_poses=BAD), INPUT, "initial_poses must be fin"),
        (lambda g: calibrate(g.rig, None, FRAMES), INPUT, "surface of a file, whose mesh cannot follow the scales"),
        (lambda g: tr.SpineLimbs("skeleton"), TYPE, "skeleton must be a Skeleton"),
        (lambda g: tr.SpineLimbs(POINT), INPUT, "skeleton must have a limb"),
        (lambda g: tr.SpineLimbs(CHAIN, 0), INPUT, "count must be at least 1"),
        (lambda g: next(label_frames(tr.PoseInitializer(g.hand), [], trusted=-1.0)), INPUT, "trusted must be zero"),
        (lambda g: tr.align(g.links, g.frame, mask=torch.ones(3) > 0), INPUT, "a depth frame has its own"),
        (lambda g: tr.align(g.links, [g.frame, DATA]), TYPE, r"data\[1\] must be a DepthFrame like the others"),
        # Known degrees of freedom and keypoints
        (on_links(locked=["ellbow"]), INPUT, "locked names 'ellbow', .* base for all six of the base, and base_x"),
        (on_links(locked=torch.ones(3) > 0), INPUT, r"locked must be a mask \(8,\)"),
        (on_links(prior=3.0), TYPE, "prior must be a pair"),
        (on_links(prior=({"hand": 0.0}, 0.1)), INPUT, "the mean of prior names 'hand'"),
        (on_links(prior=(torch.zeros(7), 0.1)), INPUT, "the mean of prior must have shape"),
        (on_links(prior=(torch.zeros(8), -0.1)), INPUT, "positive standard deviations; lock what is known exactly"),
        (on_links(prior=(BAD[:8], 0.1)), INPUT, "must be finite; name what it holds for"),
        (on_links(keypoints=CLOUD[:2]), INPUT, r"keypoints must have shape \(3, 3\), metres.* got \(2, 3\)"),
        (on_links(keypoints=CLOUD[:3, :2]), INPUT, "keypoints in pixels need the camera of a DepthFrame"),
        (on_links(keypoints=BAD[:9].reshape(3, 3)), INPUT, "all are NaN"),
        (on_links(keypoints=CLOUD[:3], keypoint_std=0.0), INPUT, "keypoint_std must be"),
        (on_links(keypoint_std=0.01), INPUT, "keypoint_std goes with keypoints"),
        (lambda g: tr.align(g.links, None), INPUT, "data must be given, or keypoints"),
        (lambda g: tr.find_pose(g.links, None, keypoints=torch.zeros(2, 3, 3)), INPUT, "alone must be of one frame"),
        # Shape coefficients
        (of_person(fit_shape="all"), INPUT, "fit_shape must be True, False or 'bones', got 'all'"),
        (of_person(fit_shape=True, locked=["base"]), INPUT, "without model_points, keypoints, locked and prior"),
        (of_person("plain", fit_shape=True), INPUT, "has no coefficients"),
        (of_person(data=FRAMES, fit_shape=True), INPUT, "takes one cloud; calibrate fits several"),
        # The base of a robot
        (base([{"turn": 0.1, "elbow": 0.2}]), INPUT, r"poses\[0\] lacks joint 'wrist'; the robot's joints are turn"),
        (base([[17.0, 51.0, -23.0]]), INPUT, r"poses\[0\] has joint 'turn' at 17, .*as degrees all would fit"),
        (base([[0.1, 2.6, 0.0]]), INPUT, "'elbow' at 2.6, beyond its limits -2.2 to 2.2; check units and order"),
        (base([[0.1, 0.2]]), INPUT, r"must have shape \(1, 3\), the joints turn, elbow, wrist, .* got \(1, 2\)"),
        (base([[0.1, 0.2, 0.3]] * 2), INPUT, "one row per frame, 1, got 2"),
        (base([[0.1, math.nan, 0.3]]), INPUT, r"poses\[0\] holds no finite number for joint 'elbow'"),
        (base([[0.0] * 3], ()), INPUT, "at least one cloud or depth frame"),
        (base([[0.0] * 3], (BAD.reshape(9, 3),)), INPUT, r"frames\[0\] must hold at least one finite point"),
        (base(["turn"]), TYPE, "poses must be numbers"),
        (base([{"turn": 0.0, "elbow": 0.0, "wrist": 0.0}, [0.0] * 3], (DATA, DATA)), TYPE, r"poses\[1\] must be"),
        # The EM loss
        (lambda g: tr.EMLoss(0.1)(CLOUD[:, :2], CLOUD), INPUT, r"posed_points must have shape .*, got \(5, 2\)"),
        (lambda g: tr.EMLoss(0.1)(CLOUD, CLOUD[0]), INPUT, r"data must have shape \(\.\.\., M, 3\), got \(3,\)"),
        (lambda g: tr.EMLoss(0.1)(CLOUD, CLOUD[:0]), INPUT, r"data must hold at least 1 point\(s\), got 0"),
        (lambda g: tr.EMLoss(0.1).posterior(CLOUD.double(), CLOUD), TYPE, r"torch\.float64 on cpu but data is"),
        (lambda g: tr.EMLoss(0.1)(CLOUD, CLOUD, torch.ones(5)), TYPE, "mask must be boolean, got dtype"),
        (lambda g: tr.EMLoss(0.1)(CLOUD, CLOUD, torch.ones(4) > 0), INPUT, r"mask must have shape \(\.\.\., 5\), got"),
        (lambda g: tr.EMLoss(0.1).virtual_observations(FRAMES, torch.zeros(3, 5, 3)), INPUT, "must broadcast"),
        # Settings
        (lambda g: tr.AlignConfig(search="often"), INPUT, "search must be one of auto, always, never; got 'often'"),
        (lambda g: tr.AlignConfig(correspondence="icp"), INPUT, "correspondence must be one of em, softassign"),
        (lambda g: tr.AlignConfig(outlier="none"), INPUT, "outlier must be one of limit, volume"),
        (lambda g: tr.AlignConfig(nan_policy="drop"), INPUT, "nan_policy must be one of raise, omit"),
        (lambda g: tr.AlignConfig(upright=(0, 1)), INPUT, "upright must have shape"),
        (lambda g: tr.AlignConfig(upright=(0, 0, 0)), INPUT, "upright must be a direction, got zeros"),
        (lambda g: tr.FindPoseConfig(upright=(0, math.nan, 1)), INPUT, "upright must be finite"),
        (lambda g: tr.AlignConfig(em_steps=0), INPUT, "em_steps must be at least 1, got 0"),
        (lambda g: tr.AlignConfig(m_steps=1.5), TYPE, "m_steps must be an integer, got float"),
        (lambda g: tr.AlignConfig(num_candidates=True), TYPE, "num_candidates must be an integer, got bool"),
        (lambda g: tr.AlignConfig(surface_steps=-1), INPUT, "surface_steps must be at least 0, got -1"),
        (lambda g: tr.AlignConfig(sharpness=0.0), INPUT, "sharpness must be positive and finite"),
        (lambda g: tr.AlignConfig(pose_atol=-1.0), INPUT, "pose_atol must be zero or positive"),
        (lambda g: tr.AlignConfig(debias=math.nan), INPUT, "debias must be zero or positive and finite"),
        (lambda g: tr.AlignConfig(inlier_distance=0.0), INPUT, "inlier_distance must be positive"),
        (lambda g: tr.AlignConfig(prior_std=-1.0), INPUT, "prior_std must be positive"),
        (lambda g: tr.FindPoseConfig(num_placed=-1), INPUT, "num_placed must be at least 1, got -1"),
        (lambda g: tr.FindPoseConfig(num_searched=1.5), TYPE, "num_searched must be an integer, got float"),
        (lambda g: tr.FindPoseConfig(num_retries=-1), INPUT, "num_retries must be at least 0, got -1"),
        (lambda g: tr.FindPoseConfig(prior_std=0.0), INPUT, "prior_std must be positive and finite, got 0.0"),
        (lambda g: tr.FindPoseConfig(nan_policy="drop"), INPUT, "nan_policy must be one of raise, omit; got 'drop'"),
        (lambda g: tr.PoseInitializerConfig(noise=0.0), INPUT, "noise must be positive"),
        (lambda g: tr.PoseInitializerConfig(fit_steps=0), INPUT, "fit_steps must be at least 1"),
        (lambda g: tr.PoseInitializerConfig(chunk=0), INPUT, "chunk must be at least 1"),
        (lambda g: tr.CalibrateConfig(rounds=0), INPUT, "rounds must be at least 1, got 0"),
        (lambda g: tr.CalibrateConfig(steps=2.0), TYPE, "steps must be an integer, got float"),
        (lambda g: tr.CalibrateConfig(size_std=0.0), INPUT, "size_std must be positive"),
        (lambda g: tr.CalibrateConfig(radius_std=math.inf), INPUT, "radius_std must be positive and finite"),
    ],
)  # fmt: skip
def test_bad_arguments(given, call, error, message):
    with pytest.raises(error, match=message):
        call(given)
