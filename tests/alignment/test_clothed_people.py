"""Bodies in clothes: a made-up body whose cloth lies some centimeters off its skin, except at head, hands and feet."""

import math

import pytest
import torch

import torchreg as tr
from tests.people import ellipsoid_body
from torchreg.errors import InputError
from torchreg.geometry.mesh import sample_surface

QUICK = tr.AlignConfig(num_model_points=200, search="never")
# By part: the one above, center and half axes of its ellipsoid, joint, metres.
PARTS = {
    "spine": ("", (0, 0, 1.2), (0.16, 0.11, 0.32), (0, 0, 1.0)),
    "head": ("spine", (0, 0.02, 1.67), (0.09, 0.11, 0.14), (0, 0, 1.52)),
    **{
        name + end: (above if above == "spine" else above + end, (side * x, 0, z), half, (side * joint[0], 0, joint[1]))
        for end, side in ((".L", 1), (".R", -1))
        for name, above, (x, z), half, joint in (
            ("upperarm", "spine", (0.36, 1.42), (0.2, 0.05, 0.05), (0.18, 1.42)),
            ("lowerarm", "upperarm", (0.66, 1.42), (0.16, 0.04, 0.04), (0.52, 1.42)),
            ("wrist", "lowerarm", (0.89, 1.42), (0.09, 0.05, 0.02), (0.81, 1.42)),
            ("upperleg", "spine", (0.1, 0.72), (0.08, 0.08, 0.25), (0.1, 0.92)),
            ("lowerleg", "upperleg", (0.1, 0.28), (0.055, 0.055, 0.24), (0.1, 0.49)),
        )
    },
    **{
        "foot" + end: ("lowerleg" + end, (side * 0.1, 0.07, 0.03), (0.045, 0.13, 0.04), (side * 0.1, 0, 0.06))
        for end, side in ((".L", 1), (".R", -1))
    },
}
COVERED = ("spine", "upperarm", "upperleg", "lowerleg")


@pytest.fixture(scope="module")
def body():
    """A body of ellipsoids, whose parts are named as anny's; its coefficients are stature and length of limbs."""
    return ellipsoid_body(PARTS, 2)


def scan(body, thickness, seed, count=1200):
    """Pose, coefficients and points of a body in cloth of a thickness, metres, with 2 mm noise and 3 % outliers."""
    generator = torch.Generator().manual_seed(seed)
    pose = body.rest_pose()
    pose[6:] = math.radians(8) * torch.randn(len(pose) - 6, generator=generator)
    pose[:6] = torch.tensor([0.2, -0.1, 0.4, 0.1, -0.05, 0.1])
    coefficients = torch.tensor([0.6, -0.5])
    mesh = tr.TriangleMesh(body.vertices(pose, coefficients), body.file_surface().faces)
    part = body.file_surface().weights.argmax(-1)
    covered = torch.tensor([name.startswith(COVERED) for name in body.part_names])[part]
    outward = thickness * covered.unsqueeze(-1) * mesh.vertex_normals()
    points = sample_surface(tr.TriangleMesh(mesh.vertices + outward, mesh.faces), count, generator=generator)[0]
    points = points + 0.002 * torch.randn(points.shape, generator=generator)
    low, high = points.amin(0) - 0.2, points.amax(0) + 0.2
    return pose, coefficients, torch.cat([points, low + (high - low) * torch.rand(36, 3, generator=generator)]), covered


def fitted(body, pose, data, **options):
    """The result from a start some centimeters off, and the error of the skin in metres."""
    start = body.rest_pose()
    start[:3] = pose[:3] + torch.tensor([0.05, -0.04, 0.05])
    return tr.align(body, data, start, fit_shape=True, config=QUICK, **options)


def skin_error(body, result, pose, coefficients):
    off = body.vertices(result.pose, result.coefficients) - body.vertices(pose, coefficients)
    return float(off.norm(dim=-1).mean())


def test_clothes_are_found_and_the_body_below_them(body, tmp_path):
    pose, coefficients, data, covered = scan(body, 0.03, seed=0)
    found, taken_for_bare = (fitted(body, pose, data, clothed=option) for option in ("auto", False))
    assert skin_error(body, found, pose, coefficients) < 0.7 * skin_error(body, taken_for_bare, pose, coefficients)
    assert taken_for_bare.clothing_offset is None
    offset = found.clothing_offset
    assert offset.shape == covered.shape
    assert float(offset.min()) >= 0
    assert float(offset[covered].mean()) == pytest.approx(0.03, abs=0.01)
    hands = torch.tensor([name.startswith("wrist") for name in body.part_names])[body.file_surface().weights.argmax(-1)]
    assert float(offset[hands].abs().max()) < 1e-6
    # Distances are to the cloth; coefficients and shape are those of the body.
    assert float(found.distances[found.inliers].abs().median()) < 0.004
    assert found.coefficients.shape == (2,)
    assert found.coefficient_covariance.shape == (2, 2)
    torch.testing.assert_close(found.shape(found.pose).points, body.vertices(found.pose, found.coefficients))
    found.save(tmp_path / "r.safetensors")
    assert torch.equal(tr.load(tmp_path / "r.safetensors").clothing_offset, offset)


def test_a_bare_body_wears_nothing(body):
    pose, coefficients, data, _ = scan(body, 0.0, seed=1)
    found, bare = (fitted(body, pose, data, clothed=option) for option in ("auto", False))
    assert found.clothing_offset is None
    errors = [skin_error(body, result, pose, coefficients) for result in (found, bare)]
    assert errors[0] < max(1.2 * errors[1], 0.006)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clothed": "yes", "fit_shape": True}, "clothed must be 'auto', True or False, got 'yes'"),
        ({"clothed": True}, "clothed=True needs fit_shape=True"),
        ({"clothed": True, "fit_shape": "bones"}, "clothed=True needs fit_shape=True"),
    ],
)
def test_what_cannot_be_clothed_is_refused(body, options, message):
    with pytest.raises(InputError, match=message):
        tr.align(body, torch.zeros(10, 3), body.rest_pose(), **options)


def test_only_bodies_wear_clothes(person):
    with pytest.raises(InputError, match="parts are named as anny's"):
        tr.align(person, torch.rand(50, 3), person.rest_pose(), fit_shape=True, clothed=True)
