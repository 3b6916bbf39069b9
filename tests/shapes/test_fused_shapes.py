"""Articulated shapes: the base at every rotation, analytic Jacobians, invariances, learnable sizes and refusals."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOF_NAMES
from torchreg.shapes.primitives import Primitive

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
ROTATIONS = {
    "zero": (0.0, 0.0, 0.0),
    "tiny": (1e-9, -2e-9, 1e-9),
    "small": (0.01, -0.02, 0.005),
    "ordinary": (0.4, -0.7, 1.1),
    "nearly pi": (0.0, math.pi - 1e-6, 0.0),
    "pi": (math.pi / math.sqrt(2), 0.0, -math.pi / math.sqrt(2)),
    "beyond pi": (2.5, 2.5, 0.0),
    "nearly 2 pi": (0.0, 0.0, 2 * math.pi - 1e-3),
}


def translation(x, y, z):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return pose


def crane(dtype=torch.float64, **options):
    """A tree with every kind of joint and solid, a mimic joint, and a frame without a solid."""
    joints = (
        Joint("base", -1, translation(0.1, 0.0, 0.2)),
        Joint("turn", 0, translation(0.0, 0.0, 0.5), "revolute", (0.0, 0.0, 1.0), -2.0, 2.0),
        Joint("lift", 1, translation(0.2, 0.0, 0.0), "revolute", (0.0, 0.6, 0.8), -1.0, 1.0),
        Joint("slide", 2, translation(0.0, 0.0, 0.6), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.5),
        Joint("hook", 3, translation(0.0, 0.1, 0.3), "revolute", (1.0, 0.0, 0.0)),
        Joint("follow", 3, translation(0.0, -0.1, 0.3), "revolute", (1.0, 0.0, 0.0), mimic=(4, -0.5, 0.2)),
    )
    primitives = (
        Primitive("cone", (0.25, 0.3, 0.2), translation(0.0, 0.0, 0.25)),
        Primitive("ellipsoid", (0.1, 0.15, 0.35), translation(0.0, 0.02, 0.3)),
        Primitive("superquadric", (0.1, 0.12, 0.2, 0.6, 0.8), translation(0.0, 0.0, 0.1)),
        Primitive("capsule", (0.1, 0.05), translation(0.0, 0.0, 0.1)),
        Primitive("ellipsoid", (0.05, 0.05, 0.15), translation(0.0, 0.0, 0.1)),
    )
    frames = ("base", "lift", "slide", "hook", "follow")
    return ArticulatedShape(KinematicTree(joints), frames, primitives, nu=0.05, dtype=dtype, **options)


def pose_with(rotation=(0.3, -0.2, 0.5), joints=(0.4, -0.3, 0.2, 0.9)):
    return torch.tensor([0.5, -1.0, 0.25, *rotation, *joints], dtype=torch.float64)


def cloud(count=60, seed=0):
    points = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return 0.6 * points + torch.tensor([0.6, -0.9, 1.0], dtype=torch.float64)


def test_names_and_neighbors():
    shape = crane()
    assert shape.dof_names == (*BASE_DOF_NAMES, "turn", "lift", "slide", "hook")
    assert shape.num_dofs == 10
    assert shape.part_names == ("base", "lift", "slide", "hook", "follow")
    assert shape.part_parents == (-1, 0, 1, 2, 2)
    pairs = {tuple(pair) for pair in shape.adjacency.triu(1).nonzero().tolist()}
    assert pairs == {(0, 1), (1, 2), (2, 3), (2, 4)}


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_the_base_turns_about_the_origin_and_then_moves(rotation):
    shape = crane()
    still = shape.part_transforms(pose_with((0.0, 0.0, 0.0)))
    still[:, :3, 3] -= pose_with()[:3]
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    base[:3, 3] = pose_with()[:3]
    expected = base @ still.detach().numpy()
    np.testing.assert_allclose(shape.part_transforms(pose_with(rotation)).detach().numpy(), expected, atol=1e-12)
    assert shape.part_transforms(pose_with(rotation).expand(2, 3, 10)).shape == (2, 3, 5, 4, 4)


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_retraction_composes_rotations_and_adds_the_rest(rotation):
    shape = crane()
    pose, step = pose_with(rotation), 0.3 * torch.sin(torch.arange(10, dtype=torch.float64))
    found = shape.retract(pose, step).numpy()
    expected = Rotation.from_rotvec(step[3:6]) * Rotation.from_rotvec(rotation)
    np.testing.assert_allclose(Rotation.from_rotvec(found[3:6]).as_matrix(), expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found[[0, 1, 2, 6, 7, 8, 9]], (pose + step)[[0, 1, 2, 6, 7, 8, 9]].numpy(), atol=1e-14)
    assert np.linalg.norm(found[3:6]) <= math.pi + 1e-9


def test_clamping_meets_the_limits_and_keeps_the_rotation():
    shape = crane()
    wild = pose_with((0.0, 0.0, 5.0), (9.0, -9.0, -9.0, 50.0))
    tame = shape.clamp(wild)
    assert tame[6:].tolist() == [2.0, -1.0, 0.0, 50.0]
    assert tame[:3].tolist() == wild[:3].tolist()
    torch.testing.assert_close(tame[3:6], torch.tensor([0.0, 0.0, 5.0 - 2 * math.pi], dtype=torch.float64))


def test_a_fixed_base_stays_at_the_origin():
    shape = crane(free_base=False)
    assert shape.clamp(pose_with())[:6].tolist() == [0.0] * 6
    assert shape.rest_pose().tolist() == [0.0] * 10


def test_the_rest_pose_is_the_limit_nearest_to_zero():
    tree = KinematicTree(
        (
            Joint("a", -1, translation(0, 0, 0)),
            Joint("b", 0, translation(0, 0, 1), "revolute", (1.0, 0.0, 0.0), 0.5, 1.0),
        )
    )
    ball = Primitive("ellipsoid", (1.0, 1.0, 1.0), translation(0, 0, 0))
    shape = ArticulatedShape(tree, ["a", "b"], [ball, ball])
    assert shape.rest_pose()[6:].tolist() == [0.5]
    shape.rest_pose()[6] = 9.0
    assert shape.rest_pose()[6:].tolist() == [0.5]


@JACFWD
@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_jacobians_in_the_pose_equal_forward_mode(rotation):
    shape, points, pose = crane(), cloud(), pose_with(rotation)
    distance, jacobian = shape.distance_jacobian(points, pose)
    torch.testing.assert_close(distance, shape.distance(points, pose), atol=1e-13, rtol=0)
    expected = torch.func.jacfwd(lambda p: shape.distance(points, p))(pose)
    torch.testing.assert_close(jacobian, expected, atol=1e-10, rtol=0)
    rows, derivative = shape.transform_jacobian(pose)

    def stacked(p):
        return shape.part_transforms(p)[..., :3, :].mT.flatten(0, 1)

    torch.testing.assert_close(rows, stacked(pose), atol=1e-14, rtol=0)
    torch.testing.assert_close(derivative, torch.func.jacfwd(stacked)(pose), atol=1e-10, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_jacobians_in_tangent_steps_equal_differences_through_the_retraction(rotation):
    shape, points, pose, h = crane(), cloud(20), pose_with(rotation), 1e-6
    distance = shape.distance_jacobian(points, pose, chart="tangent")[1]
    transform = shape.transform_jacobian(pose, chart="tangent")[1]
    for k in range(10):
        step = torch.zeros(10, dtype=torch.float64)
        step[k] = h
        ahead, behind = shape.retract(pose, step), shape.retract(pose, -step)
        slope = (shape.distance(points, ahead) - shape.distance(points, behind)) / (2 * h)
        torch.testing.assert_close(distance[:, k], slope, atol=1e-7, rtol=0)
        moved = (shape.part_transforms(ahead) - shape.part_transforms(behind)) / (2 * h)
        torch.testing.assert_close(transform[..., k], moved[:, :3, :].mT.flatten(0, 1), atol=1e-7, rtol=0)


@torch.no_grad()
def test_batches_equal_single_problems():
    shape = crane()
    poses = torch.stack([pose_with(rotation) for rotation in ROTATIONS.values()]).unflatten(0, (2, 4))
    points = torch.stack([cloud(12, seed) for seed in range(8)]).unflatten(0, (2, 4))
    distance, jacobian = shape.distance_jacobian(points, poses, chart="tangent")
    shared = shape.distance_jacobian(points[0, 0], poses)[0]
    rows, derivative = shape.transform_jacobian(poses)
    assert jacobian.shape == (2, 4, 12, 10)
    assert derivative.shape == (2, 4, 20, 3, 10)
    for i in range(2):
        for j in range(4):
            one = shape.distance_jacobian(points[i, j], poses[i, j], chart="tangent")
            torch.testing.assert_close((distance[i, j], jacobian[i, j]), one, atol=1e-12, rtol=0)
            torch.testing.assert_close(shared[i, j], shape.distance(points[0, 0], poses[i, j]), atol=1e-12, rtol=0)
            one = shape.transform_jacobian(poses[i, j])
            torch.testing.assert_close((rows[i, j], derivative[i, j]), one, atol=1e-12, rtol=0)


@torch.no_grad()
def test_distance_does_not_change_when_all_moves_rigidly():
    shape, points = crane(), cloud()
    motion = Rotation.from_rotvec([0.7, -1.9, 0.4])
    shift = np.array([3.0, -2.0, 1.0])
    pose = pose_with()
    moved = pose.clone()
    moved[3:6] = torch.from_numpy((motion * Rotation.from_rotvec(pose[3:6])).as_rotvec())
    moved[:3] = torch.from_numpy(motion.apply(pose[:3]) + shift)
    moved_points = torch.from_numpy(motion.apply(points) + shift)
    torch.testing.assert_close(shape.distance(moved_points, moved), shape.distance(points, pose), atol=1e-12, rtol=0)


@torch.no_grad()
def test_a_shape_of_mixed_solids_equals_shapes_of_one_kind():
    shape, points, pose = crane(), cloud(), pose_with()
    distances = shape.part_distances(points, pose)
    transforms = shape.part_transforms(pose)
    for part, kind in enumerate(shape.primitives.part_kinds):
        member = shape.primitives.part_kinds[:part].count(kind)
        sizes = shape.primitives.sizes[shape.primitives.kinds.index(kind)][member]
        local = translation(*shape.primitives.centers[part].tolist())
        alone = ArticulatedShape(
            KinematicTree((Joint("only", -1, transforms[part]),)), ["only"],
            [Primitive(kind, tuple(sizes.tolist()), local)], nu=0.05, dtype=torch.float64,
        )  # fmt: skip
        # One part has nothing to fuse with.
        torch.testing.assert_close(alone.distance(points, alone.rest_pose()), distances[:, part], atol=1e-12, rtol=0)


@pytest.mark.parametrize("parts", [[0], [1, 4], [4, 1, 2], [0, 1, 2, 3, 4]])
def test_some_parts_alone_equal_a_shape_whose_other_parts_are_far_away(parts):
    shape, pose = crane(), pose_with()
    points = torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    apart = crane()
    with torch.no_grad():
        for part in set(range(5)) - set(parts):
            apart.primitives.centers[part] += 1e4
    expected, expected_jacobian = apart.distance_jacobian(points, pose)
    distance, jacobian = shape.distance_jacobian(points, pose, parts=parts)
    torch.testing.assert_close(shape.distance(points, pose, parts=parts), expected)
    torch.testing.assert_close(distance, expected)
    torch.testing.assert_close(jacobian, expected_jacobian)


def test_distances_without_some_parts_equal_those_of_a_shape_where_they_are_far_away():
    shape, poses = crane(), torch.stack([pose_with(), pose_with() * 0.5])
    points = torch.randn(2, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    left_out = [(), (0,), (4, 1), (1, 2, 3)]
    with torch.no_grad():
        found = shape.distances_without(points, poses, [*left_out, range(5)])
        for parts, distances in zip(left_out, found, strict=False):
            apart = crane()
            for part in parts:
                apart.primitives.centers[part] += 1e4
            torch.testing.assert_close(distances, apart.distance(points, poses))
    assert found.shape == (5, 2, 40)
    assert bool(torch.isposinf(found[-1]).all())


def test_placed_parts_keep_their_distances_wherever_their_joints_are():
    shape, pose, parts = crane(), pose_with(), [3, 1]
    points = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    placed = shape.part_transforms(pose)[parts]
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix())
    moved[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    distances = shape.placed_distances(points @ moved[:3, :3].mT + moved[:3, 3], moved @ placed, parts)
    torch.testing.assert_close(distances, shape.part_distances(points, pose)[:, parts].mT)


def test_keypoints_are_the_origins_of_the_parts():
    shape, pose = crane(), pose_with()
    assert torch.equal(shape.keypoints(pose), shape.part_transforms(pose)[:, :3, 3])
    assert shape.keypoints(pose.expand(4, 10)).shape == (4, 5, 3)


def test_gradients_in_points_pose_and_sizes():
    shape, points = crane(), cloud(5)

    def distance(points, pose, lengths, radii):
        parameters = {"log_length_scales": lengths, "log_radius_scales": radii}
        return torch.func.functional_call(shape, parameters, (points, pose))

    shape.forward = shape.distance
    scales = [torch.linspace(-0.2, 0.2, 5, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    inputs = (points.requires_grad_(), pose_with().requires_grad_(), *scales)
    assert torch.autograd.gradcheck(distance, inputs)


def test_longer_parts_carry_the_frames_below_them_away():
    shape = crane()
    with torch.no_grad():
        shape.log_length_scales[1] = math.log(2.0)
    before, after = crane().part_transforms(pose_with()), shape.part_transforms(pose_with())
    torch.testing.assert_close(after[:2], before[:2])
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])
    # "slide" sits 0.6 up "lift"; what it slides by is no part of the length.
    shift = 0.6 * before[1, :3, 2]
    torch.testing.assert_close(after[2:, :3, 3] - before[2:, :3, 3], shift.expand(3, 3))


def test_held_sizes_change_nothing_and_are_let_go():
    shape, points = crane().requires_grad_(True), cloud()
    expected = shape.distance_jacobian(points, pose_with())
    with torch.no_grad(), shape.held_sizes():
        found = shape.distance_jacobian(points, pose_with())
        few = shape.distance(points, pose_with(), parts=[1, 3])
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(few, shape.distance(points, pose_with(), parts=[1, 3]))
    with torch.no_grad():
        shape.log_length_scales[1] = math.log(2.0)
    assert not torch.allclose(shape.distance(points, pose_with()), expected[0])
    with pytest.raises(RuntimeError, match="stop"), shape.held_sizes():
        raise RuntimeError("stop")
    assert shape.log_length_scales.requires_grad
    assert shape.distance(points, pose_with()).requires_grad


def test_moving_to_another_dtype_moves_everything():
    exact, pose = crane(), pose_with()
    shape = copy.deepcopy(exact).to(torch.float32)
    assert {tensor.dtype for tensor in [*shape.parameters(), *shape.buffers()]} == {
        torch.float32, torch.int64, torch.bool,
    }  # fmt: skip
    for found, expected in zip(
        shape.distance_jacobian(cloud().float(), pose.float()), exact.distance_jacobian(cloud(), pose), strict=True
    ):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), expected, atol=2e-5, rtol=1e-4)
    assert shape.transform_jacobian(pose.float())[1].dtype == torch.float32
    assert crane(torch.float32).rest_pose().dtype == torch.float32


def test_the_state_holds_parameters_and_what_they_multiply_and_loads():
    shape, other = crane(), crane()
    names = {"log_length_scales", "log_radius_scales", "log_nu", "log_sharpness"}
    assert {name for name, _ in shape.named_parameters()} == names
    solids = {"primitives.centers", *(f"primitives.sizes.{kind}" for kind in range(4))}
    assert {name for name in shape.state_dict() if not name.startswith("surface_points.")} == names | solids
    with torch.no_grad():
        for value in shape.state_dict().values():
            value.mul_(1.1)
    other.load_state_dict(shape.state_dict())
    assert torch.equal(other.distance(cloud(), pose_with()), shape.distance(cloud(), pose_with()))
    assert torch.equal(other(pose_with()).points, shape(pose_with()).points)


def test_the_mesh_lies_on_the_surface_in_any_pose():
    shape = crane(torch.float32)
    pose = pose_with().float()
    mesh = shape.surface_mesh(pose, spacing=0.02)
    distance = shape.distance(mesh.vertices, pose).detach()
    # Where an unrelated part takes over the surface is creased, and the field jumps.
    assert float(distance.abs().quantile(0.9)) < 0.05 * shape.nu
    edges = torch.cat([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).sort(-1).values
    assert bool((edges.unique(dim=0, return_counts=True)[1] == 2).all())
    coarse = shape.surface_mesh(spacing=0.08)
    assert 100 < len(coarse.vertices) < len(mesh.vertices)


def test_a_mesh_that_is_asked_for_again_is_that_of_the_shape_as_it_is_now():
    shape = crane(torch.float32)
    mesh = shape.surface_mesh(spacing=0.08)
    kept = mesh.vertices.clone()
    mesh.vertices.zero_()
    assert torch.equal(shape.surface_mesh(spacing=0.08).vertices, kept), "what a caller does to a mesh is the caller's"
    with torch.no_grad():
        for name, value in shape.state_dict().items():
            if name.startswith("primitives.sizes"):
                value.mul_(1.3)
    changed = shape.surface_mesh(spacing=0.08)
    assert float(shape.distance(changed.vertices, shape.rest_pose()).abs().quantile(0.9)) < 0.3 * shape.nu
    assert not torch.equal(changed.vertices, kept)


def ball():
    return Primitive("ellipsoid", (1.0, 1.0, 1.0), torch.eye(4))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"part_frames": ["base"]}, ModelError, "one primitive per part, got 2 for 1 part frames"),
        ({"part_frames": [], "primitives": []}, ModelError, "one primitive per part, got 0 for 0 part frames"),
        ({"part_frames": ["base", "base"]}, ModelError, "two parts share a frame; give each part a frame of its own"),
        ({"part_frames": ["base", "arm"]}, KeyError, "no frame is called 'arm'; known: base, tip"),
        ({"part_names": ["only"]}, ModelError, "2 parts need 2 different names, got 1"),
        ({"part_names": ["same", "same"]}, ModelError, "2 parts need 2 different names, got 1"),
        ({"nu": 0.0}, InputError, "nu must be positive and finite, got 0.0"),
        ({"nu": math.nan}, InputError, "nu must be positive and finite, got nan"),
    ],
)
def test_parts_that_do_not_fit_the_tree_are_refused(change, error, message):
    tree = KinematicTree((Joint("base", -1, torch.eye(4)), Joint("tip", 0, torch.eye(4))))
    arguments = {"part_frames": ["base", "tip"], "primitives": [ball(), ball()], **change}
    with pytest.raises(error, match=message):
        ArticulatedShape(tree, **arguments)


def test_poses_and_points_of_the_wrong_kind_are_refused():
    shape = crane()
    with pytest.raises(InputError, match=r"pose must have shape \(\.\.\., 10\), got \(9,\)"):
        shape.part_transforms(torch.zeros(9, dtype=torch.float64))
    with pytest.raises(InputError, match=r"start must have shape \(\.\.\., 10\), got \(7,\)"):
        shape.check_pose(torch.zeros(7), "start")
    assert shape.check_pose([0.0] * 10).dtype == torch.float64
    with pytest.raises(InputError, match=r"points must have shape \(\.\.\., N, 3\), got \(4, 2\)"):
        shape.distance(torch.zeros(4, 2, dtype=torch.float64), shape.rest_pose())
    with pytest.raises(InputError, match=r"points are torch.float32 on cpu but the shape is torch.float64 on cpu"):
        shape.distance(torch.zeros(4, 3), shape.rest_pose())
    with pytest.raises(InputError, match="chart must be one of pose, tangent; got 'screw'"):
        shape.part_twists(shape.rest_pose(), chart="screw")


def test_a_shape_without_a_file_has_no_file_skin():
    with pytest.raises(InputError, match="this shape has no file skin"):
        crane().file_skin()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spacing": 0.0}, "spacing must be positive"),
        ({"spacing": 1e-6}, "choose a larger one"),
        ({"pose": torch.full((27,), torch.nan)}, "pose must be finite"),
    ],
)
def test_a_surface_mesh_needs_a_spacing_and_a_pose(plain_hand, options, message):
    with pytest.raises(InputError, match=message):
        plain_hand.surface_mesh(**options)
