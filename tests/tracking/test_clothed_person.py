"""A tracked body in clothes: the first frame tells whether it wears any, and they are followed with it."""

import pytest
import torch

import torchreg as tr
from tests.alignment.test_clothed_people import body, scan  # noqa: F401  (a fixture)
from torchreg.errors import InputError

FRAMES = 4


@pytest.mark.parametrize(("thickness", "clothed"), [(0.03, "auto"), (0.0, "auto"), (0.03, False)])
def test_a_body_is_followed_in_its_clothes(body, thickness, clothed):  # noqa: F811
    pose, coefficients, points, _ = scan(body, thickness, 0)
    start = body.rest_pose()
    start[:3] = pose[:3] + torch.tensor([0.05, -0.04, 0.05])
    tracker = tr.Tracker(body, start, fit_shape=True, clothed=clothed)
    results = [tracker.step(points + torch.tensor([0.01 * number, 0, 0])) for number in range(FRAMES)]
    wears = thickness > 0 and clothed == "auto"
    assert (len(tracker.state.coefficients) > len(body.coefficient_names)) is wears
    truth = body.vertices(pose, coefficients)
    steps = [torch.tensor([0.01 * number, 0, 0]) for number in range(FRAMES)]
    skins = [body.vertices(result.pose, result.coefficients) for result in results]
    errors = [float((skin - truth - step).norm(dim=-1).mean()) for skin, step in zip(skins, steps, strict=True)]
    assert all(len(result.coefficients) == 2 for result in results)
    if wears or not thickness:
        assert errors[-1] < 1.2 * errors[0] + 0.002
        assert errors[-1] < 0.02
    # A state goes on in another tracker, in the same clothes.
    second = tr.Tracker(body, fit_shape=True, clothed=clothed)
    second.state = tracker.state
    again, more = (each.step(points + torch.tensor([0.01 * FRAMES, 0, 0])) for each in (second, tracker))
    torch.testing.assert_close(again.pose, more.pose)


def test_clothes_without_a_fitted_shape_are_refused(body):  # noqa: F811
    with pytest.raises(InputError, match="clothed=True needs fit_shape=True"):
        tr.Tracker(body, clothed=True)
