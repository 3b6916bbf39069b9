"""Robots found in registered scans: kinds of joints, axes, limits, and the file that moves as the scans did."""

import math

import pytest
import pytorch_kinematics as pk
import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan
from torchreg.io.urdf_record import UrdfPrimitive
from torchreg.registration.robots.model import find_robot, write_robot
from torchreg.registration.robots.surfaces import Target
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.posed_tree import PosedTree
from torchreg.shapes.robots import solid_mesh

EYE = torch.eye(4, dtype=torch.float64)
NOISE = 0.0005


def above(height):
    offset = EYE.clone()
    offset[2, 3] = height
    return offset


TREE = KinematicTree((
    Joint("base", -1, EYE),
    Joint("turn", 0, above(0.3), "revolute", (0.0, 0.6, 0.8)),
    Joint("rail", 1, above(0.3), "prismatic", (0.8, 0.0, 0.6)),
    Joint("plate", 2, above(0.3)),
    Joint("wrist", 3, above(0.3), "revolute", (1.0, 0.0, 0.0)),
))  # fmt: skip


@pytest.fixture(scope="module")
def scans():
    """Points, faces, the same points in eight frames, and their parts: five boxes, two of which hold together."""
    generator = torch.Generator().manual_seed(0)
    box = solid_mesh(UrdfPrimitive("box", (0.1, 0.08, 0.24), above(0.15)))
    box = fine(fine(box))
    posed = PosedTree(TREE, [joint.name for joint in TREE.joints], None, True).double()
    part = torch.arange(5).repeat_interleave(box.num_vertices)
    poses = 0.4 * torch.randn(8, 9, generator=generator, dtype=torch.float64)
    poses[0] = 0
    poses[:, 7] *= 0.2
    frames = posed.part_transforms(poses)[:, part]
    local = box.vertices.repeat(5, 1)
    deformed = (frames[..., :3, :3] @ local.unsqueeze(-1)).squeeze(-1) + frames[..., :3, 3]
    points = deformed[0].clone()
    deformed = deformed + NOISE * torch.randn(deformed.shape, generator=generator, dtype=torch.float64)
    faces = torch.cat([box.faces + number * box.num_vertices for number in range(5)])
    return points, faces, deformed, part, poses


def fine(mesh):
    """Return a mesh whose triangles are split in four."""
    corners = mesh.vertices[mesh.faces]
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    triangles = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    vertices, index = triangles.unique(dim=0, return_inverse=True)
    return TriangleMesh(vertices, index.reshape(-1, 3))


@pytest.fixture(scope="module")
def found(scans):
    points, faces, deformed, part, _ = scans
    # Registration cuts things into more bones than they have parts: the upper end of every box is a sliver here.
    height = points[:, 2] - torch.stack([points[part == number, 2].mean() for number in range(5)])[part]
    bones = part + 5 * (height > 0.08)
    return find_robot(points, RangeScan(points, faces).normals, deformed, bones)


def rand_errors(first, second):
    """Return the share of points that a labeling puts elsewhere than most points of their true part."""
    counts = torch.zeros(int(first.max()) + 1, int(second.max()) + 1).index_put_(
        (first, second), torch.ones(len(first)), accumulate=True
    )
    return 1 - float(counts.amax(1).sum()) / len(first)


def test_kinds_axes_and_values_of_joints_are_found(scans, found):
    _, _, _, part, poses = scans
    assert sorted(joint.kind for joint in found.tree.joints) == ["fixed", "prismatic", "revolute", "revolute"]
    # The plate and the part that slides are one link.
    assert found.part[part == 2].unique().tolist() == found.part[part == 3].unique().tolist()
    truth = {"revolute": [(0.0, 0.6, 0.8), (1.0, 0.0, 0.0)], "prismatic": [(0.8, 0.0, 0.6)]}
    for joint in found.tree.joints[1:]:
        axis = torch.tensor(joint.axis, dtype=torch.float64)
        best = max(abs(float(axis @ torch.tensor(known).double())) for known in truth[joint.kind])
        assert math.degrees(math.acos(min(best, 1.0))) < 1
    assert rand_errors(torch.tensor([0, 1, 2, 2, 3])[part], found.part) < 0.01
    assert found.loose == ()
    # Whatever the root, a joint's value is that of the truth but for its sign.
    spread = sorted(float((column - column[0]).abs().max()) for column in found.joint_values.mT)
    expected = sorted(float(poses[:, k].abs().max()) for k in (6, 7, 8))
    assert spread == pytest.approx(expected, abs=0.02)
    assert float(found.residuals.max()) < 2 * NOISE
    for joint, column in zip(found.tree.joints[1:], found.joint_values.mT, strict=True):
        assert joint.lower < float(column.min())
        assert joint.upper > float(column.max())


def test_the_file_moves_as_the_scans_did(scans, found, tmp_path):
    points, faces, deformed, _, _ = scans
    write_robot(tmp_path / "robot.urdf", found, points, faces)
    shape = ArticulatedShape.from_urdf(tmp_path / "robot.urdf", dtype=torch.float64)
    assert shape.part_names == tuple(f"link_{number}" for number in range(4))
    names = [joint.name for joint in found.tree.joints]
    posed = PosedTree(found.tree, names, None, True).double()
    chain = pk.build_chain_from_urdf((tmp_path / "robot.urdf").read_bytes()).to(dtype=torch.float64)
    for frame in (0, 5):
        values = found.joint_values[frame]
        pose = torch.cat([torch.zeros(6, dtype=torch.float64), values])
        torch.testing.assert_close(shape.part_transforms(pose), posed.part_transforms(pose))
        placed = chain.forward_kinematics(dict(zip(names[1:], values, strict=True)))
        for link, frames in zip(shape.part_names, posed.part_transforms(pose), strict=True):
            torch.testing.assert_close(placed[link].get_matrix()[0], frames, rtol=0, atol=1e-6)
    skin = shape.file_skin()
    pose = torch.cat([torch.zeros(6, dtype=torch.float64), found.joint_values[5]])
    moved = skin(pose) @ found.base[5, :3, :3].mT + found.base[5, :3, 3]
    assert float(torch.cdist(moved, deformed[5]).amin(-1).max()) < 10 * NOISE


def test_things_that_do_not_move_are_one_link(scans, tmp_path):
    points, faces, _, part, _ = scans
    still = points.expand(3, -1, -1)
    found = find_robot(points, RangeScan(points, faces).normals, still, part)
    assert len(found.tree) == 1
    write_robot(tmp_path / "rock.urdf", found, points, faces)
    assert float(found.residuals.max()) < 1e-9
    with pytest.raises(InputError, match="no triangles, which the meshes of links need"):
        write_robot(tmp_path / "rock.urdf", found, points, None)
    with pytest.raises(FormatError, match=r"must end in \.urdf"):
        write_robot(tmp_path / "rock.xml", found, points, faces)


def test_clouds_without_triangles_become_closed_links(scans, found, tmp_path):
    points, faces, deformed, _, _ = scans
    generator = torch.Generator().manual_seed(1)
    shares = torch.rand(len(deformed), len(faces), 3, generator=generator, dtype=torch.float64)
    places = (deformed[:, faces] * (shares / shares.sum(-1, keepdim=True)).unsqueeze(-1)).sum(-2)
    clouds = [Target(frame, torch.zeros_like(frame)) for frame in places]
    write_robot(tmp_path / "robot.urdf", found, points, None, clouds)
    skin = ArticulatedShape.from_urdf(tmp_path / "robot.urdf", dtype=torch.float64).file_skin()
    pose = torch.nn.functional.pad(found.joint_values[3], (6, 0))
    moved = skin(pose) @ found.base[3, :3, :3].mT + found.base[3, :3, 3]
    assert float(torch.cdist(deformed[3], moved).amin(-1).median()) < 0.02
    assert float(torch.cdist(moved, deformed[3]).amin(-1).median()) < 0.03
