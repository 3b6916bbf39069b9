"""What the doors of shapes refuse, and in which words."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

import torchreg as tr
from tests.shapes.kinds import D, at, machine, robot, seeded, tube
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes import link_surface, pose_conversions
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.record import build_shape, record_shape
from torchreg.shapes.surface import dense_file_skin

InputError, InputTypeError, ModelError = tr.errors.InputError, tr.errors.InputTypeError, tr.errors.ModelError
HAND = tr.Hand().requires_grad_(False)
REST, POINTS = HAND.rest_pose(), torch.zeros(2, 3)
CRANE = machine()
HAND_RECORD, RECORD = record_shape(HAND), record_shape(CRANE)
PRIOR = tr.PosePrior.fit(HAND, 0.1 * seeded(5, 27).float())
TREE = KinematicTree((Joint("base", -1, at()), Joint("tip", 0, at())))
BALL = Primitive("ellipsoid", (1.0, 1.0, 1.0), at())
Mano = pose_conversions.ManoPose


class Foot(tr.Hand):
    """A class that no release knows."""


def of_parts(**changes):
    return tr.ArticulatedShape(TREE, **{"part_frames": ["base", "tip"], "primitives": [BALL, BALL], **changes})


def of_solid(*primitive):
    return of_parts(primitives=[BALL, Primitive(*primitive)])


def rigged(**changes):
    vertices, faces, weights, joints = tube()
    arrays = {"vertices": vertices, "faces": faces, "weights": weights, "joints": joints, "parents": [-1, 0, 1, 2]}
    names = {"joint_names": ("shoulder", "elbow", "wrist", "end")}
    return tr.ArticulatedShape.from_skinned_mesh(**{**arrays, **names, **changes})


def grown(**changes):
    """A rig with three coefficients."""
    return rigged(**{"shape_dirs": 0.01 * seeded(162, 3, 3), "joint_dirs": torch.zeros(4, 3, 3), **changes})


def frames(scale):
    return at().repeat(4, 1, 1) * torch.tensor([1.0, scale, 1.0, 1.0], dtype=D)[:, None, None]


def skin(**changes):
    even = {"points": POINTS, "weights": torch.full((2, 16), 1 / 16), "reference_pose": REST, **changes}
    return tr.LinearBlendSkin(HAND, **even)


def rebuilt(record=RECORD, spec=None, **changes):
    return build_shape(replace(record, spec=replace(record.spec, **(spec or {})), **changes))


def both(function):
    """Shape coefficients by a function, which gives the rest state itself."""
    return {"shape_dirs": function, "coefficient_names": "ab", "joint_dirs": None}


REFUSED = [
    # Parts and solids.
    (lambda: of_parts(part_frames=["base"]), ModelError, "one primitive per part, got 2 for 1 part frames"),
    (lambda: of_parts(part_frames=[], primitives=[]), ModelError, "one primitive per part, got 0 for 0 part frames"),
    (lambda: of_parts(part_frames=["base", "base"]), ModelError, "two parts share a frame; give each part a frame of"),
    (lambda: of_parts(part_frames=["base", "arm"]), KeyError, "no frame is called 'arm'; known: base, tip"),
    (lambda: of_parts(part_names=["only"]), ModelError, "2 parts need 2 different names, got 1"),
    (lambda: of_parts(part_names=["same", "same"]), ModelError, "2 parts need 2 different names, got 1"),
    (lambda: of_parts(nu=0.0), InputError, "nu must be positive and finite, got 0.0"),
    (lambda: of_parts(nu=math.nan), InputError, "nu must be positive and finite, got nan"),
    (lambda: of_solid("sphere", (1.0,), at()), ModelError, "primitive 1 has kind 'sphere'; known: ellipsoid, capsule"),
    (lambda: of_solid("capsule", (1.0,), at()), ModelError, r"primitive 1 \(capsule\) needs sizes .*radius.*, got 1"),
    (lambda: of_solid("capsule", (1.0, 0.0), at()), ModelError, r"\(capsule\) has radius = 0.0; .*positive"),
    (lambda: of_solid("capsule", (math.nan, 1.0), at()), ModelError, "has half_length = nan"),
    (lambda: of_solid("capsule", (1.0, 1.0), torch.eye(3)), ModelError, r"finite \(4, 4\) pose, got shape \(3, 3\)"),
    (lambda: of_solid("capsule", (1.0, 1.0), at(math.inf)), ModelError, r"needs a finite \(4, 4\) pose"),
    (lambda: of_solid("capsule", (1.0, 1.0), 2 * at()), ModelError, "has a pose that is not a rigid motion"),
    (lambda: of_solid("capsule", (1.0, 1.0), at() * torch.tensor([-1.0, 1, 1, 1])), ModelError, "not a rigid motion"),
    # Poses and points.
    (lambda: HAND(torch.zeros(9)), InputError, r"pose must have shape \(\.\.\., 27\), got \(9,\)"),
    (lambda: CRANE.part_transforms(torch.zeros(9)), InputError, r"pose must have shape \(\.\.\., 10\), got \(9,\)"),
    (lambda: HAND.keypoints(torch.zeros(26)), InputError, r"pose must have shape \(\.\.\., 27\), got \(26,\)"),
    (lambda: HAND.check_pose(torch.zeros(7), "start"), InputError, r"start must have shape \(\.\.\., 27\), got \(7,\)"),
    (lambda: HAND.distance(torch.zeros(4, 2), REST), InputError, r"points must have shape \(\.\.\., N, 3\), got \(4,"),
    (lambda: CRANE.distance(POINTS, CRANE.rest), InputError, "points are torch.float32 on cpu but the shape is"),
    (lambda: HAND.part_twists(REST, chart="screw"), InputError, "chart must be one of pose, tangent; got 'screw'"),
    (lambda: HAND.pose_from_dict({"index_pip_flex": 0.1}), InputError, "'index_pip_flex'; did you mean"),
    (lambda: HAND.pose_from_dict({"q": 0.1}), InputError, "no degree of freedom 'q'; known: base_x"),
    (lambda: HAND.surface_mesh(spacing=0.0), InputError, "spacing must be positive"),
    (lambda: HAND.surface_mesh(spacing=1e-6), InputError, "choose a larger one"),
    (lambda: HAND.surface_mesh(pose=torch.full((27,), torch.nan)), InputError, "pose must be finite"),
    # Hands and files that are missing.
    (lambda: tr.Hand("both"), InputError, "side must be one of right, left; got 'both'"),
    (lambda: tr.Hand(scale=0.0), InputError, "scale must be positive and finite, got 0.0"),
    (lambda: tr.Hand(nu=-1.0), InputError, "nu must be positive and finite"),
    (lambda: tr.Hand(sharpness=-1.0), InputError, "sharpness must be positive and finite, got -1"),
    (HAND.file_skin, InputError, "this shape has no file skin"),
    (lambda: dense_file_skin(HAND), InputError, "no file surface: it was not read from a file with a mesh"),
    (lambda: link_surface.link_meshes(HAND), InputError, "no meshes: it was not read from a file with a mesh"),
    (lambda: tr.ArticulatedShape.from_anny("face"), InputError, "kind must be one of"),
    # Skins.
    (lambda: skin(weights=torch.ones(2, 16)), InputError, "weights must not be negative and every row must sum to one"),
    (lambda: skin(weights=torch.tensor([[2.0, -1.0] + [0.0] * 14] * 2)), InputError, "weights must not be negative"),
    (lambda: skin(weights=torch.full((2, 16), math.nan)), InputError, "every row must sum to one"),
    (lambda: skin(weights=torch.ones(2, 15)), InputError, r"weights must have shape \(2, 16\), got \(2, 15\)"),
    (lambda: skin(points=torch.zeros(2, 2)), InputError, r"points must have shape \(N, 3\)"),
    (lambda: skin(points=torch.full((2, 3), math.inf)), InputError, "points must be finite, got 6 non-finite of 6"),
    (lambda: skin(reference_pose=torch.zeros(26)), InputError, r"reference_pose must have shape \(\.\.\., 27\), got"),
    (lambda: skin(reference_pose=torch.zeros(1, 27)), InputError, r"reference_pose must have shape \(27\), got \(1,"),
    (lambda: skin(normals=torch.zeros(3, 3)), InputError, r"normals must have shape \(2, 3\), got \(3, 3\)"),
    (lambda: skin(faces=torch.tensor([[0, 1, 2]])), InputError, "faces must index the 2 vertices"),
    (lambda: tr.BendingSkin(HAND, POINTS, sharpness=0), InputError, "sharpness must be positive and finite, got 0"),
    (lambda: tr.BendingSkin(HAND, POINTS, torch.zeros(2, 27)), InputError, r"reference_pose must have shape \(27\),"),
    (lambda: tr.BendingSkin(HAND, POINTS[:0]), InputError, "points must hold at least 1 point"),
    (lambda: tr.BendingSkin(HAND, POINTS).posed_normals(REST), InputError, "this skin has no normals; pass normals="),
    (lambda: tr.sample_skin(HAND, 0), InputError, "count must be"),
    (lambda: tr.sample_skin(HAND, -3), InputError, "count must be"),
    (lambda: tr.sample_skin(HAND, 2.5), InputTypeError, "count must be"),
    # Rigs.
    (lambda: rigged(parents=[1, 2, 3, 0]), ModelError, "skeleton is cyclic: these joints never reach a root: shoulder"),
    (lambda: rigged(parents=[-1, 2, 1, 0]), ModelError, "skeleton is cyclic: these joints never reach a root: elbow,"),
    (lambda: rigged(parents=[-1, 0, -1, 2]), ModelError, r"the skeleton has 2 roots \(shoulder, wrist\): it is"),
    (lambda: rigged(parents=[-1, 0, 9, 2]), ModelError, "joint 'wrist' has parent index 9, but there are 4 joints"),
    (lambda: rigged(parents=[-1, 0, 1]), InputError, "4 joints need 4 names and parents, got 4 and 3"),
    (lambda: rigged(joint_names=["a", "b"]), InputError, "4 joints need 4 names and parents, got 2 and 4"),
    (lambda: rigged(joint_names=list("abbc")), ModelError, "must be unique, these occur more than once: b"),
    (lambda: rigged(joints=torch.full((4, 3), math.nan)), InputError, "joints must be finite, got 12 non-finite"),
    (lambda: rigged(joints=torch.zeros(4, 2)), InputError, r"joints must have shape \(J, 3\), got \(4, 2\)"),
    (lambda: rigged(joints=frames(2.0)), InputError, r"joints\[1\] is not a rigid frame"),
    (lambda: rigged(joints=frames(-1.0)), InputError, r"joints\[1\] is not a rigid frame"),
    (lambda: rigged(joints=torch.ones(4, 4, 4)), InputError, r"joints\[0\] is not a rigid frame"),
    (lambda: rigged(weights=torch.ones(3, 4)), InputError, r"weights must have shape \(162, 4\), got \(3, 4\)"),
    (lambda: rigged(weights=torch.ones(162, 4)), InputError, "weights must not be negative and every row must sum to"),
    (lambda: rigged(weights=torch.full((162, 4), math.inf)), InputError, "weights must be finite"),
    (lambda: rigged(vertices=torch.full((162, 3), math.nan)), InputError, "vertices must be finite"),
    (lambda: rigged(faces=torch.tensor([[0, 1, 170]])), InputError, "faces must index the 162 vertices"),
    (lambda: rigged(axes={"knee": ["x"]}), ModelError, "axes or limits name joints that are not there: knee; known:"),
    (lambda: rigged(axes={"wrist": ["w"]}), ModelError, "joint 'wrist' has axis 'w'; give x, y, z or a vector"),
    (lambda: rigged(axes={"wrist": [(0, 0, 0)]}), ModelError, r"'wrist' has axis \(0, 0, 0\); three finite numbers"),
    (lambda: rigged(axes={"wrist": [(1, 0)]}), ModelError, r"joint 'wrist' has axis \(1, 0\); three finite numbers"),
    (lambda: rigged(limits={"wrist": [(0, 1)]}), ModelError, "joint 'wrist' has 3 axes but 1 pairs of limits"),
    (lambda: rigged(limits={"wrist": [(1, 0)] * 3}), ModelError, "joint 'wrist_x' has limits 1.0 to 0.0"),
    (lambda: rigged(primitive="box"), InputError, "must be one of auto, ellipsoid, capsule, cone, superquadric"),
    # Shape coefficients.
    (lambda: grown(shape_dirs=torch.zeros(3, 3, 2)), InputError, r"shape_dirs must have shape \(162, 3, K\)"),
    (lambda: grown(shape_dirs=torch.full((162, 3, 2), torch.nan)), InputError, "shape_dirs must be finite, got 972"),
    (lambda: grown(joint_dirs=None), InputError, "need either joint_dirs"),
    (lambda: grown(joint_dirs=torch.zeros(4, 3, 5)), InputError, r"joint_dirs must have shape \(4, 3, 3\)"),
    (lambda: grown(joint_dirs=None, joint_regressor=torch.ones(4, 162) / 162), InputError, "joint_regressor puts"),
    (lambda: grown(joint_dirs=None, joint_regressor=torch.ones(3, 162)), InputError, r"must have shape \(4, 162\)"),
    (lambda: rigged(joint_regressor=torch.ones(4, 162) / 162), InputError, "joint_regressor needs shape_dirs"),
    (lambda: grown(coefficient_names=["a"]), InputError, "has 3 coefficients, but coefficient_names has 1"),
    (lambda: grown(coefficient_std=-1.0), InputError, "coefficient_std must be one positive number"),
    (lambda: grown(shape_dirs=lambda c: (c, c)), InputError, "coefficient_names must say how many"),
    (lambda: grown(**both(lambda c: (c, c)) | {"joint_dirs": POINTS}), InputError, "leave joint_dirs and regressor"),
    (lambda: grown(**both(lambda c: (c, c))), InputError, r"vertices of shape_dirs\(coefficients\) must have shape"),
    (lambda: grown().vertices(torch.zeros(12), torch.zeros(4)), InputError, r"coefficients must have shape \(\.\.\.,"),
    (lambda: grown().with_coefficients(torch.full((3,), torch.nan)), InputError, "coefficients must be finite"),
    (lambda: rigged().vertices(torch.zeros(12), torch.zeros(3)), InputError, "has no coefficients; make it by"),
    # Records.
    (lambda: record_shape(Foot()), InputTypeError, "only an ArticulatedShape or a Hand can be stored, got Foot"),
    (lambda: rebuilt(parameters=()), ModelError, "parameters of one floating-point dtype"),
    (lambda: rebuilt(parameters=(REST, *RECORD.parameters[1:])), ModelError, "parameters of one floating-point dtype"),
    (lambda: rebuilt(parameters=tuple(value.long() for value in RECORD.parameters)), ModelError, "of one"),
    (lambda: rebuilt(parameters=RECORD.parameters[1:]), ModelError, "the shape needs parameters of shapes"),
    (lambda: rebuilt(parameters=(RECORD.parameters[0][:3], *RECORD.parameters[1:])), ModelError, "needs parameters of"),
    (lambda: rebuilt(learnable=RECORD.learnable[1:]), ModelError, "the shape needs parameters of shapes"),
    (lambda: rebuilt(spec={"part_frames": ("base", "lift", "slide", "hook", "wing")}), ModelError, "not have: wing"),
    (lambda: rebuilt(HAND_RECORD, spec={"side": "both"}), InputError, "side must be one of right, left; got 'both'"),
    # Poses of networks, priors, and other models.
    (lambda: tr.PoseHead(HAND, rotation="euler"), InputError, "rotation must be one of"),
    (lambda: tr.PoseHead(HAND, joints="clamp"), InputError, "joints must be one of"),
    (lambda: tr.PoseHead(HAND)(torch.zeros(27)), InputError, "features must have shape"),
    (lambda: tr.PoseHead(HAND).features(torch.zeros(26)), InputError, "pose must have shape"),
    (lambda: tr.PosePrior.fit(HAND, REST[None]), InputError, "at least two finite poses"),
    (lambda: tr.PosePrior.fit(HAND, torch.zeros(9, 5)), InputError, "poses must have shape"),
    (lambda: PRIOR.init_head_(nn.Linear(8, 26)), InputError, "linear must have 27 outputs"),
    (lambda: PRIOR.init_head_(nn.Linear(8, 27, bias=False)), InputTypeError, r"torch.nn.Linear with a bias"),
    (lambda: tr.PosePrior(PRIOR.mean, PRIOR.components, 0 * PRIOR.deviations, 1.0, lower=PRIOR.lower,
                          upper=PRIOR.upper, has_base=True), InputError, "deviations must be positive"),
    (lambda: PRIOR(torch.zeros(2)), InputError, "coefficients must have shape"),
    (lambda: pose_conversions.reorder_keypoints(torch.zeros(21, 3), "mano", "nyu"), InputError, "target must be one"),
    (lambda: pose_conversions.reorder_keypoints(POINTS, "mano", "openpose"), InputError, "keypoints must have shape"),
    (lambda: pose_conversions.keypoints_from_xr(POINTS), InputError, "joints must have shape"),
    (lambda: pose_conversions.from_mano_pose(HAND, Mano(POINTS, torch.zeros(15, 3), torch.zeros(3))), InputError,
     "leading dimensions"),
    (lambda: pose_conversions.to_mano_pose(HAND, REST, flat_pose=torch.zeros(2, 27)), InputError, "flat_pose must"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "message"), REFUSED, ids=[message[:40] for *_, message in REFUSED])
def test_what_does_not_fit_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [({}, ModelError, r"crane\.urdf: no link has geometry"), ({"primitive": "cube"}, InputError, "primitive must be")],
)
def test_robots_without_geometry_are_refused(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        robot(tmp_path, '<robot name="bare"><link name="only"/></robot>', **options)
