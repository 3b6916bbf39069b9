"""Scenes of results: every kind has one, what it shows is what the result holds."""

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import unit_sphere
from torchreg.tracking.results import TrackState
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Cloud, Meshes, MovingMesh


def names(scene):
    return [layer.name for layer in scene.layers]


def test_an_alignment_shows_shape_and_data(hand, alignment):
    cloud = alignment.registered + 0.01
    scene = result_scene(alignment, shape=hand, data=[cloud])
    assert names(scene) == ["shape", "bones", "registered points", "keypoints", "data"]
    assert scene.num_frames == 1
    assert "converged" in scene.title
    paint = scene.layer("data").paint(0)
    gray = paint[~alignment.inliers]
    assert bool((gray == gray[0]).all())
    inlying = paint[alignment.inliers]
    # The surer, the darker: the posterior of the data rises along the cloud.
    assert bool((inlying[1:].sum(-1) <= inlying[:-1].sum(-1) + 1e-6).all())
    assert result_scene(alignment).layer("keypoints").visible
    with pytest.raises(InputError, match="one cloud per frame"):
        result_scene(alignment, data=[cloud, cloud])
    with pytest.raises(InputError, match=r"result\.inliers"):
        result_scene(alignment, data=[cloud[:-1]])


def test_a_track_is_empty_where_the_shape_was_not_found(hand, track, clouds):
    scene = result_scene(track, shape=hand, data=clouds)
    surface = scene.layer("shape")
    assert scene.num_frames == 3
    assert scene.seconds == pytest.approx([0.0, 0.05, 0.1])
    assert not bool(surface.points(0).isfinite().any())
    assert bool(surface.points(1).isfinite().all())
    assert len(scene.layer("keypoints").points(0)) == 0
    joints = scene.layer("bones").points(1)
    assert joints.shape == (len(hand.part_names) - 1, 2, 3)
    places = hand.part_transforms(track.poses[1])[:, :3, 3]
    assert (joints.reshape(-1, 1, 3) - places).norm(dim=-1).amin(1).max() < 1e-6
    # Data on the surface are blue, those far from it gray.
    on = surface.points(1)[:50]
    far = torch.cat([on, on + 1])
    paint = result_scene(track, shape=hand, data=[far, far, far]).layer("data").paint(1)
    assert bool((paint[:50] == paint[0]).all())
    assert not bool((paint[50:] == paint[0]).all(-1).any())
    assert names(result_scene(track)) == ["keypoints"]


def test_other_results_of_shapes(hand, demo, starts, calibration, clouds):
    assert names(result_scene(demo)) == ["shape", "bones", "data"]
    scene = result_scene(starts, shape=hand, data=clouds[1:2])
    assert scene.num_frames == 2
    assert names(scene) == ["shape", "bones", "data"]
    with pytest.raises(InputError, match="shape must be given"):
        result_scene(starts)
    scene = result_scene(calibration, shape=hand, data=clouds[1:])
    assert names(scene) == ["shape", "bones", "given shape", "given bones", "data"]


def test_a_registration_moves_from_the_source_onto_the_target(registration):
    target = unit_sphere(1)
    scene = result_scene(registration, data=[target])
    moved = scene.layer("moved, by bones")
    assert isinstance(moved, MovingMesh)
    torch.testing.assert_close(moved.points(0), registration.points)
    torch.testing.assert_close(moved.points(scene.num_frames - 1), registration.deformed)
    torch.testing.assert_close(moved.paint.to(registration.weights), registration.weights @ bone_palette(3).double())
    assert torch.equal(scene.layer("target").points(0), target.vertices)
    bones = scene.layer("bones")
    assert bones.points(0).shape == (3, 2, 3)
    assert "100% of the points match" in scene.title
    errors = scene.layers[2]
    assert errors.name.startswith("moved, by error")
    # From blue, no error, to red.
    assert float(errors.paint[0, 2]) > float(errors.paint[0, 0])
    assert float(errors.paint[-1, 0]) > float(errors.paint[-1, 2])
    points = result_scene(registration, data=[target.vertices]).layer("target")
    assert isinstance(points, Cloud)


def test_a_scan_without_triangles_is_a_cloud(registration):
    from dataclasses import replace

    scene = result_scene(replace(registration, faces=None))
    assert isinstance(scene.layer("moved, by bones"), Cloud)
    assert scene.layer("moved, by bones").num_frames == scene.num_frames


def test_a_sequence_of_scans(sequence):
    scene = result_scene(sequence, data=list(sequence.deformed))
    assert scene.num_frames == 2
    torch.testing.assert_close(scene.layer("reference, by bones").points(1), sequence.deformed[1])
    paint = scene.layer("fused, by frame").paint(0)
    assert len(paint.unique(dim=0)) == 2


def test_a_spine_shows_its_limbs_in_their_surfaces(spine):
    mesh = unit_sphere(1)
    scene = result_scene(spine, data=[mesh] * 3)
    limbs = scene.layer("limbs")
    assert torch.equal(limbs.points(2), spine.curves[2])
    assert limbs.labels == ("0", "1", "2")
    assert isinstance(scene.layer("surface"), Meshes)
    assert isinstance(result_scene(spine, data=[mesh.vertices] * 3).layer("surface"), Cloud)
    assert names(result_scene(spine)) == ["limbs"]
    with pytest.raises(InputError, match="one surface per frame"):
        result_scene(spine, data=[mesh])


def test_what_has_no_scene_is_refused(hand, spine, registration):
    with pytest.raises(InputError, match="shape has no meaning for a SpineSequence"):
        result_scene(spine, shape=hand)
    with pytest.raises(InputError, match="shape has no meaning for a ScanRegistration"):
        result_scene(registration, shape=hand)
    with pytest.raises(InputTypeError, match="not a TrackState"):
        result_scene(object.__new__(TrackState))
