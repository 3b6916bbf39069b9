"""Shapes from rigs and robots: trees, names, solids near the mesh, the file's own skin, and what is refused."""

import copy
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from torchreg.errors import FileWarning, FormatError, InputError, ModelError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf import load_rig
from torchreg.io.urdf_record import UrdfPrimitive
from torchreg.shapes import rigs
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitive_refinement import refine_primitives
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.record import build_shape, record_shape
from torchreg.shapes.rigs import spec_from_arrays
from torchreg.shapes.robots import solid_mesh
from torchreg.shapes.skin import BendingSkin, sample_skin

HAND = Path(__file__).resolve().parents[3] / "shared" / "data" / "webxr_hand_right.glb"
needs_hand = pytest.mark.skipif(not HAND.exists(), reason="the measuring data is not beside the repository")


def arm(dtype=torch.float64):
    """A tube along z with three bones, skin weights that blend over 2 cm, and a joint that carries nothing."""
    sphere = unit_sphere(2, dtype=dtype)
    vertices = sphere.vertices * torch.tensor([0.03, 0.02, 0.15], dtype=dtype) + torch.tensor([0, 0, 0.15], dtype=dtype)
    joints = torch.tensor([[0.0, 0, 0], [0, 0, 0.1], [0, 0, 0.2], [0, 0, 0.3]], dtype=dtype)
    bend = ((vertices[:, 2:] - joints[1:3, 2]) / 0.02 + 0.5).clamp(0, 1)
    weights = torch.stack([1 - bend[:, 0], bend[:, 0] - bend[:, 1], bend[:, 1], torch.zeros_like(bend[:, 0])], dim=-1)
    return vertices, sphere.faces, weights, joints


NAMES = ("shoulder", "elbow", "wrist", "end")


def test_ball_joints_become_three_stacked_axes_and_only_where_skin_moves():
    shape = ArticulatedShape.from_skinned_mesh(*arm(), [-1, 0, 1, 2], joint_names=NAMES)
    assert shape.part_names == ("shoulder", "elbow", "wrist")
    assert shape.dof_names[6:] == ("elbow_x", "elbow_y", "elbow_z", "wrist_x", "wrist_y", "wrist_z")
    assert float(shape.upper[6]) == pytest.approx(math.pi)
    assert shape.part_parents == (-1, 0, 1)


def test_axes_and_limits_can_be_chosen():
    shape = ArticulatedShape.from_skinned_mesh(
        *arm(), [-1, 0, 1, 2], joint_names=NAMES, dtype=torch.float64,
        axes={"elbow": ["x"], "wrist": [(0.0, 3.0, 4.0), "z"], "end": []},
        limits={"elbow": [(-0.1, 2.0)], "wrist": [(-1, 1), (0.5, 1)]},
    )  # fmt: skip
    assert shape.dof_names[6:] == ("elbow_x", "wrist_0", "wrist_z")
    assert shape.lower[6:].tolist() == [-0.1, -1.0, 0.5]
    pose = torch.zeros(9, dtype=torch.float64)
    pose[7] = 0.7
    turn = shape.part_transforms(pose)[2, :3, :3].detach().numpy()
    np.testing.assert_allclose(turn, Rotation.from_rotvec([0, 0.7 * 0.6, 0.7 * 0.8]).as_matrix(), atol=1e-12)


def test_joints_may_come_in_any_order_and_with_the_root_marked_as_in_smpl():
    vertices, faces, weights, joints = arm()
    order = [2, 0, 3, 1]
    shape = ArticulatedShape.from_skinned_mesh(
        vertices.numpy(), faces.numpy(), weights[:, order].numpy(), joints[order].numpy(),
        np.array([3, 2**32 - 1, 0, 1], dtype=np.uint32), joint_names=[NAMES[index] for index in order],
    )  # fmt: skip
    assert shape.up == (0, 1, 0)
    assert shape.part_names == ("shoulder", "elbow", "wrist")


@torch.no_grad()
def test_the_file_skin_is_linear_blend_skinning():
    vertices, faces, weights, positions = arm()
    frames = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    frames[:, :3, 3] = positions
    turns = Rotation.from_rotvec([[0.3, 0.2, 0.1], [1.0, 0, 0], [0, -0.5, 2.0], [0, 0, 0]]).as_matrix()
    frames[:, :3, :3] = torch.from_numpy(turns)
    shape = ArticulatedShape.from_skinned_mesh(
        vertices, faces, weights, frames, [-1, 0, 1, 2], joint_names=NAMES, dtype=torch.float64
    )
    skin = shape.file_skin()
    assert torch.equal(skin.faces, faces)
    torch.testing.assert_close(skin(shape.rest_pose()), vertices, atol=1e-14, rtol=0)
    angles = np.array([[0.4, -0.2, 0.1], [-0.3, 0.5, 0.9]])
    base = np.array([0.1, 0.2, -0.3, 0.5, -1.0, 0.2])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(base[3:]).as_matrix(), base[:3]
    world = [motion @ frames[0].numpy()]
    for joint, angle in ((1, angles[0]), (2, angles[1])):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("XYZ", angle).as_matrix()
        world.append(world[-1] @ np.linalg.inv(frames[joint - 1].numpy()) @ frames[joint].numpy() @ turn)
    points = np.concatenate([vertices.numpy(), np.ones((len(vertices), 1))], axis=1)
    expected = sum(
        weights[:, j : j + 1].numpy() * (points @ (world[j] @ np.linalg.inv(frames[j].numpy())).T) for j in range(3)
    )
    pose = torch.from_numpy(np.concatenate([base, angles.ravel()]))
    np.testing.assert_allclose(skin(pose).numpy(), expected[:, :3], atol=1e-13)


@torch.no_grad()
def test_the_file_skin_keeps_its_pose_when_limits_exclude_zero():
    vertices, *rest = arm()
    shape = ArticulatedShape.from_skinned_mesh(
        vertices, *rest, [-1, 0, 1, 2], joint_names=NAMES, axes={"elbow": ["x"]}, limits={"elbow": [(0.5, 1.0)]},
        dtype=torch.float64,
    )  # fmt: skip
    assert float(shape.rest_pose()[6]) == 0.5
    skin = shape.file_skin()
    torch.testing.assert_close(skin(torch.zeros_like(shape.rest)), vertices, atol=1e-14, rtol=0)
    assert float((skin(shape.rest_pose()) - vertices).norm(dim=-1).max()) > 0.05
    sampled = sample_skin(shape, 50)
    torch.testing.assert_close(sampled(torch.zeros_like(shape.rest)), sampled.points, atol=1e-14, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("kind", ["ellipsoid", "capsule", "cone", "superquadric", "auto"])
def test_solids_lie_near_the_mesh_and_their_length_is_along_the_bone(kind):
    vertices, *rest = arm()
    shape = ArticulatedShape.from_skinned_mesh(vertices, *rest, [-1, 0, 1, 2], primitive=kind, dtype=torch.float64)
    error = shape.distance(vertices, shape.rest_pose()).abs()
    assert float(error.mean()) < (0.004 if kind in ("capsule", "cone") else 0.002)
    assert 0.001 < shape.nu < 0.01
    if kind == "ellipsoid":
        # One ellipsoid is cut in three, and the parts together give it back.
        assert float(error.mean()) < 0.0006
        assert bool((shape.primitives.rotations[:, 2, 2].abs() > 0.8).all())


@torch.no_grad()
@needs_hand
def test_a_public_hand_with_a_flat_hierarchy():
    parents = {"wrist": None}
    for finger in ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger"):
        middle = () if finger == "thumb" else ("phalanx-intermediate",)
        above = "wrist"
        for bone in ("metacarpal", "phalanx-proximal", *middle, "phalanx-distal", "tip"):
            parents[f"{finger}-{bone}"] = above
            above = f"{finger}-{bone}"
    with pytest.raises(
        ModelError, match=r"25 roots .*it is disconnected; for a flat hierarchy name each joint's parent"
    ):
        ArticulatedShape.from_gltf(HAND)
    shape = ArticulatedShape.from_gltf(HAND, parents=parents, dtype=torch.float64)
    assert shape.num_parts == 20
    assert not any("tip" in name for name in (*shape.part_names, *shape.dof_names))
    rest, vertices = shape.rest_pose(), load_rig(HAND).vertices
    skin = shape.file_skin()
    torch.testing.assert_close(skin(rest), vertices, atol=1e-12, rtol=0)
    error = shape.distance(vertices, rest).abs()
    assert float(error.mean()) < 0.0006
    assert float(error.quantile(0.95)) < 0.002
    pose = rest.clone()
    for index, name in enumerate(shape.dof_names):
        if "phalanx" in name and name.endswith("_x"):
            pose[index] = -math.radians(30)
    truth = skin(pose)
    assert float((truth - vertices).norm(dim=-1).mean()) > 0.01
    bent = (BendingSkin(shape, vertices, rest)(pose) - truth).norm(dim=-1)
    assert float(bent.mean()) < 0.0005
    assert float(bent.quantile(0.95)) < 0.002


@torch.no_grad()
def test_refining_recovers_solids_from_points_on_their_fused_surface():
    spec = spec_from_arrays(*arm(), [-1, 0, 1, 2])
    truth = ArticulatedShape.from_spec(spec, dtype=torch.float64)
    mesh = truth.surface_mesh(spacing=0.008)
    owners = truth.part_distances(mesh.vertices, truth.rest_pose()).argmin(-1)
    transforms = truth.part_transforms(truth.rest_pose())
    shaken = []
    for part, solid in enumerate(spec.primitives):
        pose = transforms[part] @ solid.pose
        pose[:3, 3] += 0.003
        shaken.append(Primitive(solid.kind, tuple(size * 1.1 for size in solid.sizes), pose))

    def error(solids):
        moved = [
            Primitive(s.kind, s.sizes, torch.linalg.inv(transforms[part]) @ s.pose) for part, s in enumerate(solids)
        ]
        shape = ArticulatedShape(spec.tree, spec.part_frames, moved, nu=spec.nu, dtype=torch.float64)
        return float(shape.distance(mesh.vertices, shape.rest_pose()).abs().mean())

    refined = refine_primitives(shaken, truth.adjacency, spec.nu, mesh.vertices, owners)
    assert error(shaken) > 0.002
    assert error(refined) < 0.0003
    kept = refine_primitives(shaken, truth.adjacency, spec.nu, mesh.vertices, owners, max_steps=0)
    torch.testing.assert_close(kept[1].pose, shaken[1].pose)
    assert kept[1].sizes == pytest.approx(shaken[1].sizes)


class Layer(nn.Module):
    """The distance of points from a shape, as a layer."""

    def __init__(self, shape):
        super().__init__()
        self.shape = shape

    def forward(self, points):
        return self.shape.distance(points, self.shape.rest_pose())


def in_inference_first(shape, points):
    with torch.inference_mode():
        Layer(shape)(points)
    return shape.distance(points, shape.rest_pose().requires_grad_()).detach()


def of_a_loaded_state(shape, points):
    other = ArticulatedShape.from_spec(spec_from_arrays(*arm(), [-1, 0, 1, 2]), dtype=torch.float64)
    other.load_state_dict(shape.state_dict())
    return Layer(other)(points)


WAYS = {
    "as it is": lambda shape, points: Layer(shape)(points),
    "a copy": lambda shape, points: Layer(copy.deepcopy(shape))(points),
    "pickled": lambda shape, points: Layer(pickle.loads(pickle.dumps(shape)))(points),
    "in another precision first": lambda shape, points: Layer(shape.float().double())(points),
    "in inference first": in_inference_first,
    "under a transform": lambda shape, points: torch.func.vmap(Layer(shape))(points.unsqueeze(0))[0],
    "one graph": lambda shape, points: torch.compile(Layer(shape), fullgraph=True, backend="aot_eager")(points),
    "a functional call": lambda shape, points: torch.func.functional_call(
        layer := Layer(shape), dict(layer.named_buffers()), points
    ),
    "a state": of_a_loaded_state,
    "a record": lambda shape, points: Layer(build_shape(record_shape(shape)))(points),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("way", WAYS)
def test_solids_of_a_rig_are_refined_once_somebody_asks_for_them(way, monkeypatch):
    spec, points = spec_from_arrays(*arm(), [-1, 0, 1, 2]), arm()[0]
    calls = []
    refine = rigs.refine_primitives
    monkeypatch.setattr(rigs, "refine_primitives", lambda *arguments: calls.append(1) or refine(*arguments))
    shape = ArticulatedShape.from_spec(spec, dtype=torch.float64)
    shape.file_skin()(torch.zeros(shape.num_dofs, dtype=torch.float64))
    assert calls == []
    found = WAYS[way](shape, points)
    eager = ArticulatedShape.from_spec(replace(spec, primitives=tuple(spec.primitives)), dtype=torch.float64)
    torch.testing.assert_close(found, Layer(eager)(points), atol=1e-8, rtol=0)
    guess = ArticulatedShape.from_spec(replace(spec, primitives=spec.primitives.guess), dtype=torch.float64)
    assert float(found.abs().mean()) < 0.5 * float(Layer(guess)(points).abs().mean())


def changed(**entries):
    vertices, faces, weights, joints = arm()
    arguments = {"vertices": vertices, "faces": faces, "weights": weights, "joints": joints, "parents": [-1, 0, 1, 2]}
    return {**arguments, "joint_names": NAMES, **entries}


def scaled_frames(scale):
    frames = torch.eye(4).repeat(4, 1, 1)
    frames[1, :3, :3] *= scale
    return frames


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"parents": [1, 2, 3, 0]},
            ModelError,
            "the skeleton is cyclic: these joints never reach a root: shoulder, elb",
        ),
        (
            {"parents": [-1, 2, 1, 0]},
            ModelError,
            "the skeleton is cyclic: these joints never reach a root: elbow, wrist",
        ),
        ({"parents": [-1, 0, -1, 2]}, ModelError, r"the skeleton has 2 roots \(shoulder, wrist\): it is disconnected"),
        ({"parents": [-1, 0, 9, 2]}, ModelError, "joint 'wrist' has parent index 9, but there are 4 joints"),
        ({"parents": [-1, 0, 1]}, InputError, "4 joints need 4 names and parents, got 4 and 3"),
        ({"joint_names": ["a", "b"]}, InputError, "4 joints need 4 names and parents, got 2 and 4"),
        (
            {"joint_names": ["a", "b", "b", "c"]},
            ModelError,
            "frame names must be unique, these occur more than once: b",
        ),
        ({"joints": torch.full((4, 3), math.nan)}, InputError, "joints must be finite, got 12 non-finite"),
        ({"joints": torch.zeros(4, 2)}, InputError, r"joints must have shape \(J, 3\), got \(4, 2\)"),
        ({"joints": scaled_frames(2.0)}, InputError, r"joints\[1\] is not a rigid frame"),
        ({"joints": scaled_frames(-1.0)}, InputError, r"joints\[1\] is not a rigid frame"),
        ({"joints": torch.ones(4, 4, 4)}, InputError, r"joints\[0\] is not a rigid frame"),
        ({"weights": torch.ones(3, 4)}, InputError, r"weights must have shape \(162, 4\), got \(3, 4\)"),
        ({"weights": torch.ones(162, 4)}, InputError, "weights must not be negative and every row must sum to one"),
        ({"weights": torch.full((162, 4), math.inf)}, InputError, "weights must be finite"),
        ({"vertices": torch.full((162, 3), math.nan)}, InputError, "vertices must be finite"),
        ({"faces": torch.tensor([[0, 1, 170]])}, InputError, "faces must index the 162 vertices"),
        ({"axes": {"knee": ["x"]}}, ModelError, "axes or limits name joints that are not there: knee; known: shoulder"),
        ({"axes": {"wrist": ["w"]}}, ModelError, "joint 'wrist' has axis 'w'; give x, y, z or a vector"),
        ({"axes": {"wrist": [(0, 0, 0)]}}, ModelError, r"joint 'wrist' has axis \(0, 0, 0\); three finite numbers"),
        ({"axes": {"wrist": [(1, 0)]}}, ModelError, r"joint 'wrist' has axis \(1, 0\); three finite numbers"),
        ({"limits": {"wrist": [(0, 1)]}}, ModelError, "joint 'wrist' has 3 axes but 1 pairs of limits"),
        ({"limits": {"wrist": [(1, 0)] * 3}}, ModelError, "joint 'wrist_x' has limits 1.0 to 0.0"),
        ({"primitive": "box"}, InputError, "primitive must be one of auto, ellipsoid, capsule, cone, superquadric"),
    ],
)
def test_arrays_that_make_no_rig_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        ArticulatedShape.from_skinned_mesh(**changed(**change))


GRIPPER = """<?xml version="1.0"?>
<robot name="gripper">
  <link name="world"/>
  <link name="palm"><visual><geometry><box size="0.2 0.1 0.4"/></geometry></visual></link>
  <link name="left">
    <visual><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.03" length="0.2"/></geometry></visual>
    <visual><origin xyz="0 0 0.2"/><geometry><sphere radius="0.05"/></geometry></visual>
  </link>
  <link name="right">
    <visual><origin xyz="0 0 0.1"/><geometry><capsule radius="0.03" length="0.2"/></geometry></visual>
  </link>
  <joint name="mount" type="fixed"><parent link="world"/><child link="palm"/><origin xyz="0 0 1"/></joint>
  <joint name="open" type="revolute"><parent link="palm"/><child link="left"/><origin xyz="0.1 0 0.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="other" type="revolute"><parent link="palm"/><child link="right"/><origin xyz="-0.1 0 0.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="open" multiplier="-1" offset="0.3"/>
  </joint>
</robot>
"""


@pytest.fixture
def gripper(tmp_path):
    path = tmp_path / "gripper.urdf"
    path.write_text(GRIPPER)
    return path


@torch.no_grad()
def test_a_robot_keeps_its_own_solids_and_names(gripper):
    shape = ArticulatedShape.from_urdf(gripper, dtype=torch.float64)
    assert shape.dof_names[6:] == ("open",)
    assert shape.part_names == ("palm", "left", "left_1", "right")
    assert shape.primitives.part_kinds == ("superquadric", "cone", "ellipsoid", "capsule")
    pose = torch.zeros(7, dtype=torch.float64)
    pose[6] = 0.5
    transforms = shape.part_transforms(pose)
    assert torch.equal(transforms[1], transforms[2])
    points = torch.tensor([[0.0, 0.0, 0.2]], dtype=torch.float64)
    tip = points @ transforms[1, :3, :3].mT + transforms[1, :3, 3]
    # The center of the sphere at the end of the left finger, 0.05 from its surface.
    assert float(shape.part_distances(tip, pose)[0, 2]) == pytest.approx(-0.05)
    angle = math.atan2(float(transforms[3, 0, 2]), float(transforms[3, 2, 2]))
    assert angle == pytest.approx(0.3 - 0.5)


@torch.no_grad()
def test_a_robots_surface_is_that_of_its_solids_with_every_joint_at_zero(gripper):
    shape = ArticulatedShape.from_urdf(gripper, dtype=torch.float64)
    zero = torch.zeros(7, dtype=torch.float64)
    skin = shape.file_skin()
    torch.testing.assert_close(skin(zero), shape.surface.vertices, atol=1e-12, rtol=0)
    owner = shape.surface.weights.argmax(-1)
    assert sorted(owner.unique().tolist()) == [0, 1, 3]
    distance = shape.part_distances(shape.surface.vertices, zero)
    near = torch.stack([distance[:, 0], distance[:, 1:3].abs().amin(-1), distance[:, 2], distance[:, 3]], dim=-1)
    own = near.gather(-1, owner.unsqueeze(-1)).abs()
    # Corners of the box lie where its superquadric is rounded.
    assert float(own[owner != 0].max()) < 1e-9
    assert float(own[owner == 0].max()) < 0.02
    sampled = sample_skin(shape, 100)
    assert float(shape.distance(sampled.points, zero).abs().quantile(0.8)) < 0.01


@torch.no_grad()
def test_one_kind_can_be_fitted_to_every_link(gripper):
    shape = ArticulatedShape.from_urdf(gripper, primitive="ellipsoid", free_base=False, nu=0.01)
    assert shape.part_names == ("palm", "left", "right")
    assert set(shape.primitives.part_kinds) == {"ellipsoid"}
    assert shape.nu == 0.01
    assert shape.lower[:6].tolist() == [0.0] * 6
    sizes = shape.primitives.sizes[0]
    assert torch.equal(sizes.argmax(-1), torch.full((3,), 2))


def test_names_of_further_solids_avoid_those_that_are_taken(gripper):
    gripper.write_text(GRIPPER.replace('name="other"', 'name="open_1"'))
    shape = ArticulatedShape.from_urdf(gripper)
    assert shape.num_parts == 4
    assert {joint.name for joint in shape.kinematics.tree.joints} >= {"open", "open_1", "open_1_"}


@torch.no_grad()
def test_a_link_mesh_gets_a_fitted_solid(tmp_path):
    sphere = unit_sphere(2, dtype=torch.float64)
    lines = [f"v {x} {y} {z}" for x, y, z in (sphere.vertices * torch.tensor([0.1, 0.1, 0.3])).tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in sphere.faces.tolist()]
    (tmp_path / "egg.obj").write_text("\n".join(lines))
    visual = '<visual><geometry><mesh filename="egg.obj"/></geometry></visual>'
    ball = '<visual><origin xyz="0 0 0.3"/><geometry><sphere radius="0.05"/></geometry></visual>'
    path = tmp_path / "egg.urdf"
    path.write_text(f'<robot name="egg"><link name="egg">{visual}{ball}</link></robot>')
    shape = ArticulatedShape.from_urdf(path, primitive="auto", dtype=torch.float64)
    assert shape.part_names == ("egg", "egg_1")
    assert shape.primitives.part_kinds == ("ellipsoid", "ellipsoid")
    np.testing.assert_allclose(shape.primitives.sizes[0][0].numpy(), [0.1, 0.1, 0.3], rtol=0.05)
    path.write_text(f'<robot name="egg"><link name="egg">{visual.replace("egg.obj", "none.obj")}{ball}</link></robot>')
    with pytest.raises(FormatError, match=r"none.obj.* was not found"):
        ArticulatedShape.from_urdf(path, meshes="require")
    with pytest.warns(FileWarning, match=r"none.obj.* was not found"):
        assert ArticulatedShape.from_urdf(path).part_names == ("egg",)
    assert ArticulatedShape.from_urdf(path, meshes="skip").part_names == ("egg",)


def test_robots_without_geometry_are_refused(tmp_path):
    path = tmp_path / "bare.urdf"
    path.write_text('<robot name="bare"><link name="only"/></robot>')
    with pytest.raises(ModelError, match=r"bare\.urdf: no link has geometry that can be read"):
        ArticulatedShape.from_urdf(path)
    with pytest.raises(InputError, match="primitive must be one of auto, ellipsoid"):
        ArticulatedShape.from_urdf(path, primitive="cube")


VOLUMES = {
    UrdfPrimitive("box", (0.2, 0.3, 0.4), torch.eye(4).double()): 0.024,
    UrdfPrimitive("sphere", (0.3,), torch.eye(4).double()): 4 / 3 * math.pi * 0.027,
    UrdfPrimitive("cylinder", (0.3, 0.5), torch.eye(4).double()): math.pi * 0.09 * 0.5,
    UrdfPrimitive("capsule", (0.3, 0.5), torch.eye(4).double()): math.pi * 0.09 * 0.5 + 4 / 3 * math.pi * 0.027,
}


@pytest.mark.parametrize(("solid", "volume"), VOLUMES.items(), ids=[solid.kind for solid in VOLUMES])
def test_meshes_of_solids_face_outwards_and_hold_their_volume(solid, volume):
    mesh = solid_mesh(solid)
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    found = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert 0.96 * volume < found <= volume * (1 + 1e-12)
    height = 2 * float(mesh.vertices[:, 2].max())
    assert height == pytest.approx({"box": 0.4, "sphere": 0.6, "cylinder": 0.5, "capsule": 1.1}[solid.kind])
