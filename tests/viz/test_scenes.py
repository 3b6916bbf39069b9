"""Scenes as data: every kind of result has one that shows what it holds; what must fit; cameras that see everything."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.tables import each_row, refused, refusing
from torchreg.viz import bone_colors
from torchreg.viz import scene as sc
from torchreg.viz.result_scenes import result_scene

InputError = tr.errors.InputError
Cloud, Curves, Meshes, MovingMesh, Scene = sc.Cloud, sc.Curves, sc.Meshes, sc.MovingMesh, sc.Scene
POINTS = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
RED = torch.tensor([1.0, 0, 0])


@pytest.fixture(scope="module")
def ball(tools):
    return tools.ball(2)


def names(scene):
    return [layer.name for layer in scene.layers]


def test_an_alignment_shows_shape_and_data(hand, alignment):
    cloud = alignment.registered + 0.01
    scene = result_scene(alignment, shape=hand, data=[cloud])
    assert names(scene) == ["shape", "bones", "registered points", "keypoints", "data"]
    assert scene.num_frames == 1
    assert "converged" in scene.title
    paint = scene.layer("data").paint(0)
    gray, inlying = paint[~alignment.inliers], paint[alignment.inliers]
    assert bool((gray == gray[0]).all())
    # The surer, the darker: the posterior of the data rises along the cloud.
    assert bool((inlying[1:].sum(-1) <= inlying[:-1].sum(-1) + 1e-6).all())
    assert result_scene(alignment).layer("keypoints").visible


def test_a_track_is_empty_where_the_shape_was_not_found(hand, track, clouds):
    scene = result_scene(track, shape=hand, data=clouds)
    surface = scene.layer("shape")
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
    paint = result_scene(track, shape=hand, data=[torch.cat([on, on + 1])] * 3).layer("data").paint(1)
    assert bool((paint[:50] == paint[0]).all())
    assert not bool((paint[50:] == paint[0]).all(-1).any())
    assert names(result_scene(track)) == ["keypoints"]


def test_other_results_of_shapes(hand, demo, starts, calibration, clouds):
    assert names(result_scene(demo)) == ["shape", "bones", "data"]
    scene = result_scene(starts, shape=hand, data=clouds[1:2])
    assert (scene.num_frames, names(scene)) == (2, ["shape", "bones", "data"])
    scene = result_scene(calibration, shape=hand, data=clouds[1:])
    assert names(scene) == ["shape", "bones", "given shape", "given bones", "data"]


def test_a_registration_moves_from_the_source_onto_the_target(registration, ball):
    scene = result_scene(registration, data=[ball])
    moved = scene.layer("moved, by bones")
    assert isinstance(moved, MovingMesh)
    torch.testing.assert_close(moved.points(0), registration.points)
    torch.testing.assert_close(moved.points(scene.num_frames - 1), registration.deformed)
    paint = registration.weights @ bone_colors.bone_palette(3).double()
    torch.testing.assert_close(moved.paint.to(paint), paint)
    assert torch.equal(scene.layer("target").points(0), ball.vertices)
    assert scene.layer("bones").points(0).shape == (3, 2, 3)
    assert "100% of the points match" in scene.title
    errors = scene.layers[2]
    assert errors.name.startswith("moved, by error")
    # From blue, no error, to red.
    assert float(errors.paint[0, 2]) > float(errors.paint[0, 0])
    assert float(errors.paint[-1, 0]) > float(errors.paint[-1, 2])
    assert isinstance(result_scene(registration, data=[ball.vertices]).layer("target"), Cloud)
    cloud = result_scene(replace(registration, faces=None)).layer("moved, by bones")
    assert isinstance(cloud, Cloud)
    assert cloud.num_frames == scene.num_frames


def test_sequences_of_scans_and_spines_show_every_frame(sequence, spine, ball):
    scene = result_scene(sequence, data=list(sequence.deformed))
    assert scene.num_frames == 2
    torch.testing.assert_close(scene.layer("reference, by bones").points(1), sequence.deformed[1])
    assert len(scene.layer("fused, by frame").paint(0).unique(dim=0)) == 2
    scene = result_scene(spine, data=[ball] * 3)
    limbs = scene.layer("limbs")
    assert torch.equal(limbs.points(2), spine.curves[2])
    assert limbs.labels == ("0", "1", "2")
    assert isinstance(scene.layer("surface"), Meshes)
    assert isinstance(result_scene(spine, data=[ball.vertices] * 3).layer("surface"), Cloud)
    assert names(result_scene(spine)) == ["limbs"]


@each_row(
    ("alignment", {"data": [POINTS, POINTS]}, "one cloud per frame"),
    ("alignment", {"data": [POINTS]}, r"result\.inliers"),
    ("starts", {}, "shape must be given"),
    ("spine", {"data": [POINTS]}, "one surface per frame"),
    ("spine", {"shape": True}, "shape has no meaning for a SpineSequence"),
    ("registration", {"shape": True}, "shape has no meaning for a ScanRegistration"),
)
def test_results_without_a_scene_are_refused(request, hand, name, settings, words):
    if "shape" in settings:
        settings = {"shape": hand}
    with pytest.raises(InputError, match=words):
        result_scene(request.getfixturevalue(name), **settings)
    with pytest.raises(tr.errors.InputTypeError, match="not a TrackState"):
        result_scene(object.__new__(tr.TrackState))


def test_patches_hold_every_face_once_with_its_color(ball):
    paint = (ball.vertices + 1) / 2
    surface = MovingMesh("ball", ball.vertices, ball.faces, paint)
    patches = surface.patches()
    assert 1 < len(patches) <= 48
    found, expected = torch.cat([used[faces] for used, faces, _ in patches]), ball.faces
    assert sorted(found.sort(-1).values.tolist()) == sorted(expected.sort(-1).values.tolist())
    for used, faces, color in patches:
        assert int(faces.max()) == len(used) - 1
        assert (paint[used[faces]].mean(1) - torch.tensor(color)).abs().max() < 0.35
    assert len(surface.patches(most=8)) <= 8
    ((used, faces, color),) = MovingMesh("ball", ball.vertices, ball.faces, (1.0, 0.0, 0.5)).patches()
    assert torch.equal(used[faces], ball.faces)
    assert color == (1.0, 0.0, 0.5)
    assert MovingMesh("empty", ball.vertices, ball.faces[:0], torch.zeros_like(ball.vertices)).patches() == []


def test_layers_move_or_stand_still(ball):
    moving = torch.stack([ball.vertices, ball.vertices + 1])
    scene = Scene("two", (MovingMesh("ball", moving, ball.faces), Cloud("still", [POINTS], (1.0, 0.0, 0.0))))
    assert (scene.num_frames, scene.seconds) == (2, [0.0, 0.05])
    assert torch.equal(scene.layer("ball").points(1), moving[1])
    assert torch.equal(scene.layer("still").points(1), POINTS)
    assert torch.equal(scene.layer("still").paint(1), RED.expand(20, 3))
    assert Scene("timed", scene.layers, torch.tensor([3.0, 4.5])).seconds == [0.0, 1.5]
    curves = torch.arange(24.0).reshape(2, 4, 3)
    for given, frame in ((curves, 0), (torch.stack([curves - 1, curves]), 1)):
        assert torch.equal(Curves("limbs", given, torch.eye(3)[:2]).points(frame), curves)
    with pytest.raises(InputError, match="no layer 'cube'; it has ball, still"):
        scene.layer("cube")


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.0, 0.0, 8.0), (0.3, -4.0, 5.0)])
@pytest.mark.parametrize("up", [None, (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
def test_the_camera_sees_everything(ball, offset, up):
    points = ball.vertices * torch.tensor([1.0, 0.4, 0.6]) + torch.tensor(offset)
    position, target, upright = Scene("ball", (MovingMesh("ball", points, ball.faces),), up=up).camera()
    forward = (target - position) / (target - position).norm()
    rays = torch.nn.functional.normalize(points.double() - position, dim=-1)
    assert float(torch.acos((rays @ forward).clamp(-1, 1)).max()) < sc.FIELD_OF_VIEW / 2
    assert float(torch.linalg.cross(forward, upright).norm()) > 0.5
    guessed = [0, -1, 0] if math.hypot(*offset) > 1 else [0, 0, 1]
    assert upright.tolist() == (guessed if up is None else list(up))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-0.6, 0.0, -0.8)])
def test_the_camera_looks_at_the_side_that_was_scanned(ball, direction):
    towards = torch.tensor(direction)
    scan = MovingMesh("scan", ball.vertices, ball.faces[(ball.vertices[ball.faces].mean(1) @ towards) > 0.2])
    for up in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
        position, target, _ = Scene("scan", (scan,), up=up).camera()
        looking = (position - target) / (position - target).norm()
        assert float(looking @ towards.double()) > 0.8
        assert float(looking[1] * up[1]) > 0.1  # from above


def test_outliers_do_not_decide_where_the_camera_stands(ball):
    far, near = Cloud("data", [100 * POINTS], (0.0, 0.0, 0.0)), Meshes("ball", [ball])
    assert Scene("both", (near, far)).diagonal == pytest.approx(Scene("one", (near,)).diagonal)
    assert Scene("points", (far,)).diagonal > 50
    hidden = MovingMesh("hidden", torch.full((4, 3), torch.nan), ball.faces[:0], visible=False)
    assert Scene("nothing", (hidden,)).diagonal == 1.0


BLACK, FACES = (0.0, 0.0, 0.0), torch.arange(18).reshape(6, 3)


test_layers_that_do_not_fit = refusing(lambda _, make: make(MovingMesh("ball", POINTS, FACES)), InputError)(
    (lambda one: MovingMesh("ball", POINTS, FACES, POINTS[:3]), "paint of ball"),
    (lambda one: Cloud("data", [POINTS[:, :2]], BLACK), r"frames\[0\] of data"),
    (lambda one: Cloud("data", [POINTS], [POINTS, POINTS]), "paints of data must be 1"),
    (lambda one: Cloud("data", [POINTS], [POINTS[:3]]), r"paints\[0\] of data"),
    (lambda one: Curves("limbs", torch.zeros(1, 2, 3), torch.zeros(1, 3), labels=("a", "b")), "labels of limbs"),
    (lambda one: Scene("twice", (one, one)), "different names"),
    (lambda one: Scene("empty", ()), "got none"),
    (lambda one: Scene("a", (Cloud("b", [POINTS] * 2, BLACK), Cloud("c", [POINTS] * 3, BLACK))), "got 2, 3"),
    (lambda one: Scene("late", (one,), torch.arange(2.0)), "times"),
)


def test_colors_of_bones_are_distinct_and_mixed_by_weights():
    colors = bone_colors.bone_palette(40)
    assert colors.shape == (40, 3)
    assert bool(((colors >= 0) & (colors <= 1)).all())
    for count, apart in ((40, 0.03), (6, 0.2)):
        assert float((torch.cdist(colors[:count], colors[:count]) + torch.eye(count)).min()) > apart
    palette = bone_colors.bone_palette(3)
    assert torch.equal(palette, colors[:3])
    weights = torch.tensor([[1.0, 0, 0], [0, 2.0, 0], [0.5, 0, 0.5]])
    expected = torch.stack([palette[0], palette[1], (palette[0] + palette[2]) / 2])
    torch.testing.assert_close(bone_colors.weight_colors(weights), expected)
    assert torch.autograd.gradcheck(bone_colors.weight_colors, ((weights.double() + 0.1).requires_grad_(),))


def test_errors_run_from_blue_to_red():
    errors = torch.tensor([0.0, 0.75, 1.0, 5.0])
    colors = bone_colors.error_colors(errors, 1.0)
    assert [int(color.argmax()) for color in colors[:2]] == [2, 0]
    torch.testing.assert_close(colors[2], colors[3])
    torch.testing.assert_close(bone_colors.error_colors(2 * errors, 2.0), colors)
    inside = torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: bone_colors.error_colors(e, 1.0), (inside,))


def test_colors_are_written(tools, tmp_path):
    model, points, faces = tools.bones_scene(bones=4, dtype=torch.float32)
    for moved in (False, True):
        bone_colors.save_weight_ply(tmp_path / "w.ply", model, points, faces, moved=moved)
        cloud = tr.load_points(tmp_path / "w.ply")
        torch.testing.assert_close(cloud.points, model(points).detach() if moved else points)
        assert torch.equal(cloud.faces, faces)
        expected = bone_colors.weight_colors(model.weights_at(points)).detach()
        torch.testing.assert_close(cloud.colors, expected, atol=1 / 255, rtol=0)
    several = tr.GridLBS(model.grid, model.weights, model.transforms.expand(2, 4, 4, 4))
    bone_colors.save_weight_ply(tmp_path / "w.ply", several, points)
    errors = torch.linspace(0, 2, len(points))
    errors[3] = math.inf
    bone_colors.save_error_ply(tmp_path / "e.ply", points, errors, faces)
    cloud, ends = tr.load_points(tmp_path / "e.ply"), [0, -1]
    assert torch.equal(cloud.points, points)
    torch.testing.assert_close(cloud.colors[3], torch.full((3,), 0.5), atol=1 / 255, rtol=0)
    colors = bone_colors.error_colors(errors[ends], 2.0)
    torch.testing.assert_close(cloud.colors[ends], colors, atol=1 / 255, rtol=0)
    bone_colors.save_error_ply(tmp_path / "e.ply", points, torch.zeros(len(points)), largest=0.1)
    assert tr.load_points(tmp_path / "e.ply").faces is None
    bone_colors.save_error_ply(tmp_path / "e.ply", points, torch.full((len(points),), math.nan))
    refused(
        (lambda: bone_colors.save_weight_ply("w.ply", several, points, moved=True), "the model holds several poses"),
        (lambda: bone_colors.save_weight_ply("w.xyz", model, points), r"path must end in .ply"),
        (lambda: bone_colors.save_error_ply("e.ply", points, errors[:3]), "errors must have shape"),
        (lambda: bone_colors.save_error_ply("e.ply", points, -1 - errors), "errors must not be negative"),
        (lambda: bone_colors.save_error_ply("e.ply", points, errors, largest=-1.0), "largest must be zero"),
        error=InputError,
    )
