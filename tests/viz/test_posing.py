"""Posing with and without a page: picks, drags, pins, undo, key poses and files; `tests/web` uses a real mouse."""

import math
import threading
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
import torch

import torchreg as tr
from tests.tables import each_row
from torchreg.viz import picking, pose_app, pose_editor

InputError, PoseEditor = tr.errors.InputError, pose_editor.PoseEditor


@pytest.fixture
def editor(registration):
    return PoseEditor(registration)


@pytest.fixture
def posed(editor):
    """An editor whose right end was moved."""
    editor.add_handle(ends(editor)[1])
    editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.4, 0.0])})
    return editor


def ends(editor):
    return int(editor.points[:, 0].argmin()), int(editor.points[:, 0].argmax())


def same(one, other):
    assert torch.equal(one.transforms, other.transforms)
    assert torch.equal(one.targets, other.targets)
    assert (one.vertices, one.pinned) == (other.vertices, other.pinned)


def test_the_start_is_the_registration_and_frames_are_those_of_sequences(editor, registration, sequence):
    torch.testing.assert_close(editor.moved(), registration.deformed)
    assert editor.colors.shape == (len(editor.points), 3)
    assert not any((editor.can_undo, editor.can_redo, editor.undo(), editor.redo()))
    torch.testing.assert_close(PoseEditor(sequence, frame=1).moved(), sequence.deformed[1])


def test_a_dragged_handle_comes_to_its_target_and_pins_hold(editor):
    left, right = ends(editor)
    assert [editor.add_handle(vertex) for vertex in (left, right, left)] == [0, 1, 0]  # each once
    editor.drag({1: editor.placed()[1] + torch.tensor([0.0, -0.3, 0.2])})
    torch.testing.assert_close(editor.state.targets[0], editor.placed()[0])  # a free handle follows
    editor.pin(0)
    held, target = editor.placed()[0], editor.placed()[1] + torch.tensor([-0.2, -0.5, 0.0])
    for share in torch.linspace(0.1, 1, 10):
        solution = editor.drag({1: editor.placed()[1] + share * (target - editor.placed()[1])})
    assert isinstance(solution, tr.PoseSolution)
    placed = editor.placed()
    assert float((placed[1] - target).norm()) < 0.01 * editor.diagonal
    assert float((placed[0] - held).norm()) < 0.01 * editor.diagonal
    torch.testing.assert_close(placed[1], editor.moved()[right])


def test_undo_and_redo_restore_every_number(editor):
    left, right = ends(editor)
    states = [editor.state]

    def step(change):
        change()
        states.append(editor.state)

    def drag():
        editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.1, 0.05])})
        editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.1, 0.05])})
        editor.commit()
        editor.commit()  # nothing new

    for change in (
        lambda: editor.add_handle(right), drag, drag, lambda: editor.add_handle(left), lambda: editor.pin(1),
        lambda: editor.remove_handle(0),
    ):  # fmt: skip
        step(change)
    for state in states[-2::-1]:
        assert editor.undo()
        same(editor.state, state)
    assert not editor.can_undo
    for state in states[1:]:
        assert editor.redo()
        same(editor.state, state)
    editor.undo()
    editor.reset()
    same(editor.state, states[0])
    assert not editor.can_redo
    assert editor.undo()
    same(editor.state, states[-2])


def test_a_drag_that_was_not_committed_is_undone_as_a_step(editor):
    editor.add_handle(0)
    before = editor.state
    editor.drag({0: editor.placed()[0] + 0.1})
    assert not editor.redo()
    assert editor.undo()
    same(editor.state, before)
    assert editor.redo()


def test_key_poses_become_the_animation_of_the_file(editor, tmp_path):
    editor.add_handle(ends(editor)[1])
    assert editor.remove_key() == 0
    editor.add_key()
    with pytest.raises(InputError, match="two key poses"):
        editor.animation()
    editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.6, 0.0])})
    assert editor.add_key() == 2
    poses = editor.animation(4)
    assert poses.shape == (5, 3, 4, 4)
    torch.testing.assert_close(poses[-1], editor.state.transforms, atol=1e-6, rtol=0)
    size = editor.save_gltf(tmp_path / "keys.glb").stat().st_size
    assert editor.add_key() == 3
    assert editor.save_gltf(tmp_path / "more.glb").stat().st_size > size
    assert editor.remove_key() == 2


def test_between_key_poses_limbs_swing_and_keep_their_length(tools):
    model, _, _ = tools.bar_model(4)
    own = model.transforms.detach()
    keys = torch.stack([torch.eye(4, dtype=own.dtype).expand_as(own), own, own @ own])
    found = pose_editor.between_poses(model, keys, torch.tensor([0.0, 1.0, 2.0]))
    torch.testing.assert_close(found, keys, atol=1e-9, rtol=0)
    still = pose_editor.between_poses(model, keys[:1], torch.zeros(2))
    torch.testing.assert_close(still, keys[[0, 0]], atol=1e-9, rtol=0)
    tree = model.skeleton(keys)
    halves = pose_editor.between_poses(model, keys, torch.tensor([0.5, 1.25]), tree=tree)
    rotation = halves[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).to(rotation).expand_as(rotation))
    # Bones that meet at a joint in the key poses meet there in between.
    for bone, parent in enumerate(tree.parents):
        if parent >= 0:
            joint = torch.cat([tree.origins[bone], torch.ones(1)]).to(halves)
            gap, ends = ((poses[:, bone] @ joint - poses[:, parent] @ joint).norm(dim=-1) for poses in (halves, keys))
            assert float(gap.max()) <= float(ends.max()) + 1e-9
    # Halfway between rest and a turn of 0.35 about z per joint is half of that turn.
    relative = rotation[0, 0].mT @ rotation[0, 1]
    assert float(torch.atan2(relative[1, 0], relative[0, 0]).abs()) == pytest.approx(0.175, abs=1e-6)


def test_files_hold_the_pose(editor, registration, tmp_path):
    with pytest.raises(InputError, match="nothing was posed yet"):
        editor.save_pose(tmp_path / "pose.safetensors")
    editor.add_handle(ends(editor)[1])
    editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.4, 0.0])})
    saved = tr.load(editor.save_pose(tmp_path / "pose.safetensors"))
    torch.testing.assert_close(PoseEditor(registration, start=saved.transforms).moved(), editor.moved())
    cloud = tr.load_points(editor.save_ply(tmp_path / "pose.ply"))
    np.testing.assert_allclose(cloud.points, editor.moved(), atol=1e-6)
    assert len(cloud.faces) == len(registration.faces)
    assert editor.save_gltf(tmp_path / "pose.glb").exists()


def test_blends_that_gltf_lacks_are_written_vertex_by_vertex(registration, tmp_path):
    record = replace(registration.model.record(), blend="dual_quaternion")
    editor = PoseEditor(replace(registration, model=type(registration.model).from_record(record)))
    path = editor.save_gltf(tmp_path / "twisted.glb")
    gltf = pygltflib.GLTF2().load(str(path))
    assert not gltf.skins
    assert len(gltf.meshes[0].primitives[0].targets) == 10
    # The fixture lies flat: z is upright, and turned to the file's y.
    x, y, z = registration.points.unbind(-1)
    np.testing.assert_allclose(tr.load_points(path).points, torch.stack((x, z, -y), -1), atol=1e-5)


@each_row(
    (lambda e: e.add_handle(-1), "vertex must be from 0"),
    (lambda e: e.drag({1: torch.zeros(3)}), "one of 1 handles, got 1"),
    (lambda e: e.drag({0: torch.full((3,), torch.nan)}), "targets"),
    (lambda e: e.pin(1), "one of 1 handles"),
    (lambda e: e.remove_handle(4), "one of 1 handles"),
    (lambda e: PoseEditor(replace(e.result, faces=None)).save_gltf("cloud.glb"), "export PLY"),
    (lambda e: PoseEditor(e.result, start=torch.eye(4).expand(2, 4, 4)), "start must have shape"),
    (lambda e: PoseEditor(e.sequence, frame=2), "frame must be from 0 to 1"),
)
def test_bad_arguments_are_refused(posed, registration, sequence, call, words):
    posed.result, posed.sequence = registration, sequence
    with pytest.raises(InputError, match=words):
        call(posed)


def rays(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    origin = 3 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return origin, 0.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.4 - origin


def test_rays_meet_a_ball_where_the_quadratic_says(tools):
    ball, motion = tools.ball(4), tools.motion([3.0, -2, 1, 0.4, 1.1, -0.7])
    vertices = ball.vertices.double()
    moved = vertices @ motion[:3, :3].mT + motion[:3, 3]
    for origin, direction in zip(*rays(20), strict=True):
        face, share = picking.meet_triangles(ball.vertices, ball.faces, origin, direction)
        assert float(share.sum()) == pytest.approx(1.0)
        assert bool((share >= 0).all())
        off = share.double() @ vertices[ball.faces[face]] - origin
        unit = direction / direction.norm()
        along = -(origin @ unit)
        depth = along - math.sqrt(along**2 - float(origin @ origin) + 1)
        assert float((off - depth * unit).norm()) < 0.03  # the facets of the ball lie this far inside
        assert float((off - (off @ unit) * unit).norm()) < 1e-5  # on the ray
        # Moving all changes nothing.
        place, turned = motion[:3, :3] @ origin + motion[:3, 3], motion[:3, :3] @ direction
        one = picking.pick_vertex(vertices, ball.faces, origin, direction)
        assert picking.pick_vertex(moved, ball.faces, place, 7 * turned) == one


def test_shapes_behind_or_beside_a_ray_are_not_met_and_the_first_point_near_it_is(tools):
    ball, origin = tools.ball(4), torch.tensor([0.0, 0, 3])
    for direction in (torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, -0.5])):
        assert picking.meet_triangles(ball.vertices, ball.faces, origin, direction) is None
        assert picking.pick_vertex(ball.vertices, ball.faces, origin, direction) is None
    # Also from within.
    assert picking.meet_triangles(ball.vertices, ball.faces, torch.zeros(3), torch.tensor([0.0, 0, 1])) is not None
    edge_on, flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]])
    ray = torch.tensor([-1.0, 0.2, 0]), torch.tensor([1.0, 0, 0])
    assert picking.meet_triangles(edge_on, flat, *ray) is None
    points = torch.tensor([[0.0, 0, 5], [0.01, 0, 2], [0.5, 0, 1], [0, 0, -1]])
    ray = torch.zeros(3), torch.tensor([0.0, 0, 2])
    assert picking.pick_vertex(points, None, *ray) == 1
    assert picking.pick_vertex(points, torch.zeros(0, 3, dtype=torch.long), *ray, reach=0.001) == 0
    assert picking.pick_vertex(points[2:], None, *ray) is None


class Gated:
    """A worker whose jobs wait for a gate, and the jobs that it did."""

    def __init__(self):
        self.gate, self.started, self.done, self.threads = threading.Event(), threading.Event(), [], set()
        self.worker = pose_app.LatestWorker(self.work, pytest.fail)

    def work(self, job):
        self.started.set()
        self.gate.wait(5)
        self.done.append(dict(job))
        self.threads.add(threading.current_thread())


def test_the_newest_job_replaces_the_ones_that_wait():
    gated = Gated()
    assert math.isnan(gated.worker.median_seconds)
    gated.worker.submit("a", 0)
    gated.started.wait(5)
    for number in range(1, 100):
        gated.worker.submit("a", number)
    gated.worker.submit("b", "other")
    assert not gated.worker.flush(timeout=0.01)
    gated.gate.set()
    assert gated.worker.flush(timeout=5)
    assert gated.done == [{"a": 0}, {"a": 99, "b": "other"}]
    assert len(gated.threads) == 1
    assert len(gated.worker.seconds) == 2
    assert gated.worker.median_seconds >= 0
    gated.worker.close()


def test_jobs_that_wait_can_be_dropped_and_errors_are_passed_on():
    gated, errors = Gated(), []
    gated.worker.submit("a", 0)
    gated.started.wait(5)
    gated.worker.submit("a", 1)
    threading.Timer(0.05, gated.gate.set).start()
    gated.worker.drop()
    gated.worker.close()
    gated.worker.submit("a", 2)
    assert gated.worker.flush(5)  # nothing is waited for that will never be done
    assert gated.done == [{"a": 0}]

    def work(job):
        if job["a"] < 0:
            raise InputError("a must not be negative")
        gated.done.append(job["a"])

    worker = pose_app.LatestWorker(work, errors.append)
    for job in (-1, 1):
        worker.submit("a", job)
        assert worker.flush(5)
    worker.close()
    assert [str(error) for error in errors] == ["a must not be negative"]
    assert gated.done[1:] == [1]


@pytest.fixture
def app(registration, tmp_path):
    pytest.importorskip("viser", reason="the viewer needs viser")
    with pose_app.PoseApp(PoseEditor(registration), output=tmp_path / "posed", port=0) as app:
        yield app


def press(app, label):
    button = next(h for h in app.server.gui._gui_input_handle_from_uuid.values() if h.label == label)
    for callback in button._impl.update_cb:
        callback(None)


def shape(app):
    nodes, number = [], 0
    while (node := app.server.scene.get_handle_by_name(f"/shape/{number}")) is not None:
        nodes, number = [*nodes, torch.from_numpy(node.vertices)], number + 1
    return torch.cat(nodes)


def pick_end(app, sign=1.0):
    points = app.editor.moved()
    vertex = int((sign * points[:, 0]).argmax())
    outside = points[vertex] + torch.tensor([5.0 * sign, 0, 0], dtype=torch.float64)
    return app.pick(outside, points[vertex] - outside)


def raise_end(app, up=(0.0, 0.3, 0.0)):
    assert pick_end(app) == 0
    app.release(0, app.editor.placed()[0] + torch.tensor(up))


def test_the_shape_follows_a_drag_and_undo_brings_it_back(app):
    assert app.pick(torch.tensor([0.0, 0, 50]), torch.tensor([0.0, 0, 1])) is None
    assert (pick_end(app), app.selected) == (0, 0)
    gizmo = app.server.scene.get_handle_by_name("/handles/0")
    assert gizmo.position == pytest.approx(app.editor.placed()[0].tolist())
    pick_end(app, -1.0)
    before, state = shape(app), app.editor.state
    target = app.editor.placed()[1] + torch.tensor([0.2, -0.4, 0.3])
    for share in torch.linspace(0, 1, 200):
        app.drag(1, torch.lerp(app.editor.state.targets[1], target, share))
    app.release(1, target)
    assert len(app.worker.seconds) < 200  # the mouse does not wait
    assert float((app.editor.placed()[1] - target).norm()) < 0.01 * app.editor.diagonal
    assert not torch.equal(shape(app), before)
    assert gizmo.position == pytest.approx(app.editor.placed()[0].tolist(), abs=1e-5)
    press(app, "Undo")
    assert torch.equal(shape(app), before)
    assert torch.equal(app.editor.state.transforms, state.transforms)
    press(app, "Redo")
    assert float((app.editor.placed()[1] - target).norm()) < 0.01 * app.editor.diagonal
    press(app, "Reset")
    assert app.selected == -1
    assert app.server.scene.get_handle_by_name("/handles/0") is None
    assert torch.equal(shape(app), before)


def test_handles_are_pinned_and_removed(app):
    pick_end(app)
    app.release(0, torch.full((3,), torch.nan))
    assert "targets" in app._status.content
    pick_end(app, -1.0)
    app._pin(True)
    assert app.editor.state.pinned == (False, True)
    app._select(0)
    assert not app._pinned.value
    press(app, "Remove")
    assert app.editor.state.pinned == (True,)
    press(app, "Remove")
    press(app, "Remove")  # nothing is left
    assert app.selected == -1


def test_files_are_written_and_none_is_overwritten(app, tmp_path):
    press(app, "Save pose")
    assert "nothing was posed yet" in app._status.content
    raise_end(app)
    for label in ("Save pose", "Export PLY", "Export PLY", "Export glTF"):
        press(app, label)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"posed.safetensors", "posed.ply", "posed_2.ply", "posed.glb"} <= names
    assert torch.equal(tr.load(tmp_path / "posed.safetensors").transforms, app.editor.state.transforms)


def test_key_poses_are_played_and_the_pose_stays(app):
    press(app, "Play")
    assert "two key poses" in app._status.content
    press(app, "Add key pose")
    raise_end(app)
    press(app, "Add key pose")
    after = shape(app)
    app.play()
    assert torch.equal(shape(app), after)
    press(app, "Remove last")
    assert "1 key poses" in app._keys.content


def test_clouds_are_posed_too(app, registration, tmp_path):
    editor = PoseEditor(replace(registration, faces=None))
    with pose_app.PoseApp(editor, output=tmp_path / "cloud", port=0) as other:
        raise_end(other, (0.0, 0.2, 0.0))
        points = torch.from_numpy(other.server.scene.get_handle_by_name("/shape").points)
        torch.testing.assert_close(points, editor.moved().float())
