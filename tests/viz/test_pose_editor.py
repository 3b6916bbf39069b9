"""Posing without a window: handles come to their targets, pins hold, undo brings back every number."""

import numpy as np
import pygltflib
import pytest
import torch

from torchreg.errors import InputError
from torchreg.io.points import load_points
from torchreg.registration.results import PoseSolution
from torchreg.storage import load
from torchreg.viz.pose_editor import PoseEditor


@pytest.fixture
def editor(registration):
    return PoseEditor(registration)


def ends(editor):
    return int(editor.points[:, 0].argmin()), int(editor.points[:, 0].argmax())


def same(one, other):
    assert torch.equal(one.transforms, other.transforms)
    assert torch.equal(one.targets, other.targets)
    assert one.vertices == other.vertices
    assert one.pinned == other.pinned


def test_the_start_is_the_registration(editor, registration):
    torch.testing.assert_close(editor.moved(), registration.deformed)
    assert editor.colors.shape == (len(editor.points), 3)
    assert not editor.can_undo
    assert not editor.can_redo
    assert not editor.undo()
    assert not editor.redo()


def test_a_dragged_handle_comes_to_its_target_and_pins_hold(editor):
    left, right = ends(editor)
    assert editor.add_handle(left) == 0
    assert editor.add_handle(right) == 1
    assert editor.add_handle(left) == 0  # once
    editor.pin(0)
    held, target = editor.placed()[0], editor.placed()[1] + torch.tensor([-0.2, -0.5, 0.0])
    for share in torch.linspace(0.1, 1, 10):
        solution = editor.drag({1: editor.placed()[1] + share * (target - editor.placed()[1])})
    assert isinstance(solution, PoseSolution)
    placed = editor.placed()
    assert float((placed[1] - target).norm()) < 0.01 * editor.diagonal
    assert float((placed[0] - held).norm()) < 0.01 * editor.diagonal
    torch.testing.assert_close(placed[1], editor.moved()[right])


def test_a_free_handle_follows(editor):
    left, right = ends(editor)
    editor.add_handle(left)
    editor.add_handle(right)
    editor.drag({1: editor.placed()[1] + torch.tensor([0.0, -0.3, 0.2])})
    torch.testing.assert_close(editor.state.targets[0], editor.placed()[0])


def test_undo_and_redo_restore_every_number(editor):
    left, right = ends(editor)
    states = [editor.state]
    editor.add_handle(right)
    states.append(editor.state)
    for step in range(3):
        editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.1, 0.05])})
        if step == 1:
            editor.commit()
            states.append(editor.state)
    editor.commit()
    editor.commit()  # nothing new
    states.append(editor.state)
    editor.add_handle(left)
    states.append(editor.state)
    editor.pin(1)
    states.append(editor.state)
    editor.remove_handle(0)
    states.append(editor.state)
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


def test_what_was_not_committed_is_undone_as_a_step(editor):
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


def test_files_hold_the_pose(editor, registration, tmp_path):
    with pytest.raises(InputError, match="nothing was posed yet"):
        editor.save_pose(tmp_path / "pose.safetensors")
    editor.add_handle(ends(editor)[1])
    editor.drag({0: editor.placed()[0] + torch.tensor([0.0, -0.4, 0.0])})
    saved = load(editor.save_pose(tmp_path / "pose.safetensors"))
    again = PoseEditor(registration, start=saved.transforms)
    torch.testing.assert_close(again.moved(), editor.moved())
    cloud = load_points(editor.save_ply(tmp_path / "pose.ply"))
    np.testing.assert_allclose(cloud.points, editor.moved(), atol=1e-6)
    assert len(cloud.faces) == len(registration.faces)
    assert editor.save_gltf(tmp_path / "pose.glb").exists()


def test_blends_that_gltf_does_not_know_are_written_vertex_by_vertex(registration, tmp_path):
    from dataclasses import replace

    record = replace(registration.model.record(), blend="dual_quaternion")
    twisted = replace(registration, model=type(registration.model).from_record(record))
    editor = PoseEditor(twisted)
    path = editor.save_gltf(tmp_path / "twisted.glb")
    gltf = pygltflib.GLTF2().load(str(path))
    assert not gltf.skins
    assert len(gltf.meshes[0].primitives[0].targets) == 10
    # The fixture lies flat: z is upright, and turned to the file's y.
    x, y, z = registration.points.unbind(-1)
    np.testing.assert_allclose(load_points(path).points, torch.stack((x, z, -y), -1), atol=1e-5)


def test_frames_of_sequences(sequence, registration):
    torch.testing.assert_close(PoseEditor(sequence, frame=1).moved(), sequence.deformed[1])
    with pytest.raises(InputError, match="frame must be from 0 to 1"):
        PoseEditor(sequence, frame=2)
    with pytest.raises(InputError, match="start must have shape"):
        PoseEditor(registration, start=torch.eye(4).expand(2, 4, 4))


def test_what_does_not_fit_is_refused(editor, registration, tmp_path):
    from dataclasses import replace

    with pytest.raises(InputError, match="vertex must be from 0"):
        editor.add_handle(-1)
    with pytest.raises(InputError, match="one of 0 handles, got 0"):
        editor.drag({0: torch.zeros(3)})
    editor.add_handle(3)
    with pytest.raises(InputError, match="targets"):
        editor.drag({0: torch.full((3,), torch.nan)})
    with pytest.raises(InputError, match="one of 1 handles"):
        editor.pin(1)
    with pytest.raises(InputError, match="one of 1 handles"):
        editor.remove_handle(4)
    cloud = PoseEditor(replace(registration, faces=None))
    with pytest.raises(InputError, match="export PLY"):
        cloud.save_gltf(tmp_path / "cloud.glb")
