"""Data at one place, on a line or on a plane, are never called converged, and coarse rounding is told."""

import pytest
import torch

import torchreg as tr
from tests import bodies
from torchreg.geometry.mesh import unit_sphere

SEARCH = tr.FindPoseConfig(num_candidates=4, num_placed=2, num_searched=1, search_rounds=1, num_model_points=60)
DRAWN = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
CLOUDS = {
    "zeros": (torch.zeros(200, 3), "at one place"),
    "place": (torch.full((200, 3), 0.3), "at one place"),
    "line": (DRAWN * torch.tensor([0.2, 0.0, 0.0]), "on a line"),
    "plane": (DRAWN * torch.tensor([0.2, 0.15, 0.0]), "on a plane"),
}


@pytest.fixture(params=CLOUDS)
def cloud(request):
    return CLOUDS[request.param]


@pytest.fixture(scope="module")
def finger():
    return bodies.finger()


def test_alignment_tracker_and_calibration_say_what_is_wrong(finger, cloud):
    data, where = cloud
    with pytest.warns(tr.errors.DegenerateDataWarning, match=f"lie {where}.* determine no pose"):
        found = tr.align(finger, data, finger.rest_pose(), config=tr.AlignConfig(search="never"))
    assert found.status is tr.Status.DEGENERATE
    assert not found.status.usable


def test_tracker_and_calibration_say_it_too(finger):
    data, where = CLOUDS["plane"]
    with pytest.warns(tr.errors.DegenerateDataWarning, match=where):
        assert set(tr.Tracker(finger).run([data, data]).statuses) == {tr.Status.DEGENERATE}
    with pytest.warns(tr.errors.DegenerateDataWarning, match=where):
        assert tr.calibrate(finger, [data, data], finger.rest_pose().repeat(2, 1)).status is tr.Status.DEGENERATE


def test_nothing_is_confident(finger, cloud):
    data, where = cloud
    with pytest.warns(tr.errors.DegenerateDataWarning, match=where):
        assert float(tr.find_pose(finger, data, config=SEARCH).confidence) == 0
    layer = tr.PoseInitializer(finger, tr.PoseInitializerConfig(find_pose=SEARCH))
    assert float(layer(data, start=finger.rest_pose()).confidence) == 0


def test_scans_that_may_slide_are_told(cloud):
    data, where = cloud
    if where == "at one place":
        with pytest.raises(tr.errors.InputError, match="3 places or more"):
            tr.RangeScan(data)
        return
    with pytest.warns(tr.errors.DegenerateDataWarning, match=where):
        found = tr.register(tr.RangeScan(data), tr.RangeScan(data + 0.01), 2, 8, bodies.QUICK)
    assert not found.status.usable
    if where == "on a plane":
        with pytest.warns(tr.errors.DegenerateDataWarning, match=where):
            found = tr.register_sequence([tr.RangeScan(data), tr.RangeScan(data + 0.01)], 2, 8, bodies.QUICK)
        assert found.status is tr.Status.DEGENERATE


def test_a_flat_surface_has_a_note():
    ball = unit_sphere(2)
    flat = tr.TriangleMesh(ball.vertices * torch.tensor([1.0, 1.0, 0.0]), ball.faces)
    assert any("flat" in note for note in tr.skeletonize(flat).notes)
    assert tr.extract_spine([flat], workers=1).status is not tr.Status.CONVERGED


def test_single_precision_far_away_is_warned_of(finger):
    near, start = tr.sample_skin(finger, 150)(finger.rest_pose()).detach(), finger.rest_pose()
    start[:3] = torch.tensor([1e4, -2e4, 1.5e4])
    with pytest.warns(tr.errors.PrecisionWarning, match="float32 rounds to 0.0024.*compute in float64"):
        tr.align(finger, near + start[:3], start, config=tr.AlignConfig(search="never"))
