"""Rigs with shape coefficients: rest states, vertices in any pose, the rig of one person, files, and bad arrays."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, at, seeded
from torchreg.shapes.anny_body import Phenotypes
from torchreg.shapes.shaped import ShapedSkin, ShapedTree
from torchreg.shapes.shaped_surface import ShapedSurface

PARENTS = [-1, 0, 1, 0]


def body():
    """Arrays as those of SMPL: a tube with four joints, a regressor, and three directions; made up."""
    generator = torch.Generator().manual_seed(0)
    turn = torch.arange(6, dtype=D) * torch.pi / 3
    ring = torch.stack([0.1 * turn.cos(), 0.1 * turn.sin(), torch.zeros(6, dtype=D)], dim=-1)
    vertices = torch.cat([ring + torch.tensor([0.0, 0.0, 0.1 * level], dtype=D) for level in range(9)])
    low = torch.arange(8).repeat_interleave(6) * 6 + torch.arange(6).repeat(8)
    high = torch.arange(8).repeat_interleave(6) * 6 + (torch.arange(6).repeat(8) + 1) % 6
    faces = torch.cat([torch.stack([low, high, low + 6], -1), torch.stack([high, high + 6, low + 6], -1)])
    regressor = torch.rand(4, len(vertices), generator=generator, dtype=D)
    regressor = regressor * (torch.arange(len(vertices)) // 14 == torch.arange(4)[:, None])
    weights = torch.rand(len(vertices), 4, generator=generator, dtype=D).pow(4)
    dirs = 0.02 * torch.randn(len(vertices), 3, 3, generator=generator, dtype=D)
    return vertices, faces, weights / weights.sum(1, keepdim=True), regressor / regressor.sum(1, keepdim=True), dirs


def made(**changes):
    vertices, faces, weights, regressor, dirs = body()
    given = {"shape_dirs": dirs, "joint_regressor": regressor, "dtype": D, **changes}
    return tr.ArticulatedShape.from_skinned_mesh(vertices, faces, weights, regressor @ vertices, PARENTS, **given)


@pytest.fixture(scope="module")
def shape():
    return made()


def drawn(shape, count):
    return 0.4 * seeded(count, shape.num_dofs, seed=1), seeded(count, 3, seed=2)


def smpl(pose, coefficients):
    """SMPL's own recipe, without offsets by pose: shape, regress joints, chain, blend."""
    vertices, _, weights, regressor, dirs = body()
    rest = vertices + dirs @ coefficients
    joints = regressor @ rest
    # Degrees of freedom come joint by joint, breadth first.
    angles = [torch.zeros(3, dtype=D), pose[6:9], pose[12:15], pose[9:12]]
    turns = []
    for joint, parent in enumerate(PARENTS):
        about = [at(turn=torch.eye(3, dtype=D)[axis] * angles[joint][axis]) for axis in range(3)]
        local = at(*(joints[joint] - (joints[parent] if parent >= 0 else 0))) @ about[0] @ about[1] @ about[2]
        turns.append(local if parent < 0 else turns[parent] @ local)
    moved = torch.stack([
        (rest - joints[joint]) @ turn[:3, :3].mT + turn[:3, 3] for joint, turn in enumerate(turns)
    ])  # fmt: skip
    return torch.einsum("vj,jvc->vc", weights, moved) @ at(turn=pose[3:6])[:3, :3].mT + pose[:3]


def test_vertices_are_those_of_the_recipe_of_smpl(shape):
    poses, coefficients = drawn(shape, 2)
    expected = torch.stack([smpl(*pair) for pair in zip(poses, coefficients, strict=True)])
    torch.testing.assert_close(shape.vertices(poses, coefficients), expected, atol=1e-12, rtol=0)


def test_the_mean_person_is_the_rig_itself(shape):
    pose = drawn(shape, 1)[0][0]
    torch.testing.assert_close(shape.vertices(pose, torch.zeros(3, dtype=D)), shape(pose).points, atol=1e-13, rtol=0)
    assert torch.equal(shape.vertices(pose), shape(pose).points)


def test_one_person_is_a_rig_of_its_own():
    shape = made()
    pose, coefficients = (value[0] for value in drawn(shape, 1))
    shape.up = (0.0, 0.0, -1.0)
    person = shape.with_coefficients(coefficients)
    assert person.up == shape.with_bone_coefficients().up == shape.up
    assert person.coefficient_names == ()
    assert person.dof_names == shape.dof_names
    torch.testing.assert_close(person(pose).points, shape.vertices(pose, coefficients), atol=1e-12, rtol=0)


def test_a_grown_person_has_grown_solids():
    vertices, *_, regressor, _ = body()
    shape = made(shape_dirs=vertices.unsqueeze(-1), joint_regressor=regressor)
    person = shape.with_coefficients(torch.tensor([0.5], dtype=D))
    for solid, grown in zip(shape.primitives.solids(), person.primitives.solids(), strict=True):
        torch.testing.assert_close(torch.tensor(grown.sizes), 1.5 * torch.tensor(solid.sizes))
        torch.testing.assert_close(grown.pose[:3, 3], 1.5 * solid.pose[:3, 3])


def test_gradients_by_pose_and_coefficients(shape):
    pose, coefficients = (value[0].requires_grad_() for value in drawn(shape, 1))
    assert torch.autograd.gradcheck(lambda p, c: shape.vertices(p, c)[::9], (pose, coefficients))


@pytest.mark.parametrize("is_function", [False, True])
def test_analytic_derivatives_are_those_of_autograd(is_function):
    vertices, *_, regressor, dirs = body()

    def person(coefficients):
        grown = vertices + torch.einsum("vck,...k->...vc", dirs, coefficients.sin())
        return grown, regressor @ grown

    options = {"shape_dirs": person, "joint_regressor": None, "coefficient_names": "abc"} if is_function else {}
    shape = made(**options)
    tree = ShapedTree(shape, shape.space)
    faces = shape.surface.faces[::9]
    shares = torch.tensor([0.5, 0.2, 0.3], dtype=D).expand(len(faces), 3)
    skin = ShapedSkin(tree, faces, shares, shape.surface.weights[faces].mean(1))
    state = torch.cat(drawn(shape, 2), dim=-1)
    zero = torch.zeros_like(state)
    expected = torch.stack([
        torch.autograd.functional.jacobian(lambda step, row=row: skin(tree.retract(state, step))[row], zero)[:, :, row]
        for row in range(2)
    ])  # fmt: skip
    rows, jacobian = skin.row_jacobian(state)
    torch.testing.assert_close(skin.place(rows), skin(state))
    torch.testing.assert_close(jacobian, expected, atol=1e-10, rtol=0)
    points, normals, along = skin.normal_jacobian(state)
    torch.testing.assert_close(points, skin(state))
    torch.testing.assert_close(along, torch.einsum("bnc,bncd->bnd", normals, expected), atol=1e-10, rtol=0)


def test_normals_are_those_of_the_posed_faces(shape):
    tree = ShapedTree(shape, shape.space)
    faces = shape.surface.faces
    # One weight for all corners: then a face moves rigidly, and its normal is that of the posed mesh.
    skin = ShapedSkin(tree, faces, torch.full((len(faces), 3), 1 / 3, dtype=D), torch.eye(4, dtype=D)[faces[:, 0] % 4])
    pose, coefficients = (value[:1] for value in drawn(shape, 1))
    _, normals = skin.oriented(torch.cat([pose, coefficients], dim=-1))
    posed = tree.posed(torch.cat([pose, coefficients], dim=-1), shape.space)
    turns = posed.turns[0, faces[:, 0] % 4]
    corners = (turns.unsqueeze(1) @ posed.vertices[0][faces].unsqueeze(-1)).squeeze(-1)
    expected = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    torch.testing.assert_close(normals[0], torch.nn.functional.normalize(expected, dim=-1))


def test_data_on_the_other_side_of_a_limb_are_far_from_the_surface(shape):
    tree, faces = ShapedTree(shape, shape.space), shape.surface.faces
    skin = ShapedSkin(tree, faces, torch.full((len(faces), 3), 1 / 3, dtype=D), shape.surface.weights[faces].mean(1))
    state = torch.zeros(1, shape.num_dofs + 3, dtype=D)
    points, normals = skin.oriented(state)
    lifted = points + 0.01 * normals
    told = ShapedSurface(skin, normals, 1.0).distance(lifted, state)
    torch.testing.assert_close(told, torch.full_like(told, 0.01))
    assert bool((ShapedSurface(skin, -normals, 1.0).distance(lifted, state) > 1).all())
    assert torch.equal(ShapedSurface(skin, torch.zeros_like(normals), 1.0).distance(lifted, state), told)


def archive(path, **changes):
    vertices, faces, weights, regressor, dirs = body()
    arrays = {
        "v_template": vertices, "f": faces, "weights": weights, "J_regressor": regressor, "shapedirs": dirs,
        "kintree_table": torch.tensor([[2**32 - 1, *PARENTS[1:]], [0, 1, 2, 3]]), **changes,
    }  # fmt: skip
    given = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    np.savez(path, **given, allow_pickle=True)
    return path


def test_an_archive_of_arrays(tmp_path):
    shape = tr.ArticulatedShape.from_npz(archive(tmp_path / "model.npz"), num_coefficients=2, dtype=D)
    pose, coefficients = (value[0] for value in drawn(shape, 1))
    coefficients[2] = 0
    assert shape.coefficient_names == ("shape_0", "shape_1")
    torch.testing.assert_close(shape.vertices(pose, coefficients[:2]), smpl(pose, coefficients), atol=1e-6, rtol=0)


OBJECTS = np.array([{}], dtype=object)
ARRAYS = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"shapedirs": None}, tr.errors.FormatError, r"model.npz: lacks the array 'shapedirs'"),
        ({"J_regressor": np.ones((4, 9))}, tr.errors.InputError, r"J_regressor must have shape \(J, 54\)"),
        ({"kintree_table": None, "f": OBJECTS}, tr.errors.FormatError, "lacks the array 'kintree_table'"),
        (dict.fromkeys(ARRAYS, OBJECTS), tr.errors.FormatError, "pickled objects are never loaded"),
    ],
)
def test_archives_that_do_not_fit(tmp_path, changes, error, message):
    with pytest.raises(error, match=message):
        tr.ArticulatedShape.from_npz(archive(tmp_path / "model.npz", **changes))


@pytest.mark.skipif(find_spec("anny") is None, reason="anny is not installed")
def test_anny_at_rest():
    anny = pytest.importorskip("anny")
    shape = tr.ArticulatedShape.from_anny("body")
    model = anny.Anny()
    generator = torch.Generator().manual_seed(2)
    phenotypes = torch.rand(2, len(shape.coefficient_names), generator=generator, dtype=D)
    assert shape.coefficient_names == tuple(model.phenotype_labels)
    with torch.no_grad():
        expected = model(phenotype_kwargs=phenotypes)["rest_vertices"]
    found = shape.vertices(shape.rest_pose(), phenotypes.float())
    torch.testing.assert_close(found.double(), expected, atol=2e-6, rtol=0)


def test_phenotypes_know_their_derivatives():
    anchors = [torch.tensor([0.0, 0.4, 1.0], dtype=D), torch.tensor([0.0, 1.0], dtype=D)]
    mask = torch.tensor([[1, 0, 0, 0, 1, 1], [0, 1, 0, 1, 0, 0], [0, 0, 1, 0, 0, 1], [0, 0, 0, 0, 0, 0]], dtype=D)
    features = Phenotypes(anchors, torch.tensor([0.3], dtype=D), mask, seeded(4, 5))
    # At an anchor too, where the slope jumps.
    coefficients = torch.tensor([[0.2, 0.7], [0.4, 0.1], [0.9, 1.0]], dtype=D)
    expected = torch.stack([torch.autograd.functional.jacobian(features, row) for row in coefficients])
    torch.testing.assert_close(features.jacobian(coefficients), expected)
