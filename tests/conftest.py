"""One thread for torch: the problems here are small, and the tests may run beside others. Hands that take a second."""

import gc
from pathlib import Path

import pytest
import torch

from torchreg.alignment.results import AlignResult
from torchreg.datasets import hand as made
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin

torch.set_num_threads(1)

# Center and half axes of each part, metres, and its joint; the trunk first.
PARTS = {
    "trunk": ((0.0, 0.0, 0.0), (0.16, 0.1, 0.3), (0.0, 0.0, 0.0)),
    "head": ((0.0, 0.0, 0.42), (0.08, 0.09, 0.13), (0.0, 0.0, 0.3)),
    "left": ((0.4, 0.0, 0.2), (0.26, 0.045, 0.045), (0.16, 0.0, 0.2)),
    "right": ((-0.4, 0.0, 0.2), (0.26, 0.045, 0.045), (-0.16, 0.0, 0.2)),
}

# Long runs of everything together. Tracing slows them most, and their parts have tests of their own, which are traced.
UNTRACED = {
    "benchmarks", "docs", "experiments", "web", "test_align_scans.py", "test_bad_input.py", "test_calibrate.py",
    "test_clouds.py", "test_compiled_shapes.py", "test_contracts.py", "test_degenerate_data.py", "test_descent.py",
    "test_em_loss.py", "test_extract_spine.py", "test_far_coordinates.py", "test_find_pose.py", "test_loaded_data.py",
    "test_poses_from_skeletons.py", "test_prior.py", "test_search.py", "test_shapes_as_modules.py", "test_storage.py",
    "test_tip_correspondences.py", "test_track.py",
}  # fmt: skip


# Smoke tests of benchmarks, compilation, training and the papers' twins: .ci/nightly runs them.
SLOW = {"benchmarks", "test_compiled_shapes.py", "test_matcher_training.py", "test_neural_init.py", "test_papers.py"}


def pytest_collection_modifyitems(items):
    """Leave coverage out of long runs, and mark the slow ones."""
    for item in items:
        parts = item.path.relative_to(Path(__file__).parent).parts
        for marker, names in (("no_cover", UNTRACED), ("slow", SLOW)):
            if names.intersection(parts):
                item.add_marker(marker)


def pytest_collection_finish():
    """Keep the collector from looking through modules and tests again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def plain_hand():
    """A hand in float32 that takes no gradients; not to be changed."""
    return Hand().requires_grad_(False)


@pytest.fixture(scope="session")
def plain_hand_skin(plain_hand):
    """400 model points of the hand."""
    return sample_skin(plain_hand, 400)


@pytest.fixture(scope="session")
def plain_hand_surface(plain_hand):
    """The hand's whole surface as a skin with faces, from which clouds are drawn."""
    return made.surface_skin(plain_hand, spacing=0.005)


@pytest.fixture(scope="session")
def arm():
    """A body with an arm on one hinge, in float64, that takes no gradients; not to be changed."""
    eye = torch.eye(4, dtype=torch.float64)
    joints = Joint("base", -1, eye), Joint("arm", 0, eye, "revolute", (0.0, 1.0, 0.0), -2.0, 2.0)
    center = eye.clone()
    center[0, 3] = 0.15
    solids = Primitive("ellipsoid", (0.06, 0.09, 0.05), eye), Primitive("ellipsoid", (0.15, 0.03, 0.04), center)
    tree = KinematicTree(joints)
    shape = ArticulatedShape(tree, ["base", "arm"], solids, nu=0.01, dtype=torch.float64)
    return shape.requires_grad_(False)


@pytest.fixture
def result() -> AlignResult:
    return AlignResult(
        pose=torch.zeros(27),
        registered=torch.zeros(5, 3),
        keypoints=torch.zeros(21, 3),
        distances=torch.zeros(4),
        inliers=torch.ones(4, dtype=torch.bool),
        posterior=torch.ones(4),
        sigma=torch.tensor(0.002),
        cost=torch.tensor(1.5),
        status=Status.CONVERGED,
    )


@pytest.fixture(scope="session")
def person():
    """A figure of ellipsoids whose coefficients are its stature, the girth of its trunk and its arms' length."""
    ball = unit_sphere(2, dtype=torch.float64)
    meshes, weights, joints, dirs = [], [], [], []
    for number, (center, axes, joint) in enumerate(PARTS.values()):
        center, axes, joint = (torch.tensor(value, dtype=torch.float64) for value in (center, axes, joint))
        vertices = ball.vertices * axes + center
        meshes.append(TriangleMesh(vertices, ball.faces))
        weights.append(torch.eye(len(PARTS), dtype=torch.float64)[number].expand(len(vertices), -1))
        joints.append(joint)
        girth = vertices * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) if number == 0 else 0 * vertices
        reach = (vertices - joint) * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64) if number > 1 else 0 * vertices
        dirs.append(torch.stack([0.15 * vertices, 0.25 * girth, 0.2 * reach], dim=-1))
    mesh, places = concatenate(meshes), torch.stack(joints)
    joint_dirs = torch.stack([0.15 * places, torch.zeros_like(places), torch.zeros_like(places)], dim=-1)
    return ArticulatedShape.from_skinned_mesh(
        mesh.vertices, mesh.faces, torch.cat(weights), places, [-1, 0, 0, 0], joint_names=list(PARTS),
        shape_dirs=torch.cat(dirs), joint_dirs=joint_dirs, coefficient_names=["stature", "girth", "reach"],
        up=(0.0, 0.0, 1.0),
    )  # fmt: skip
