"""Frames that do not fit a sequence: errors that name them, or limbs interpolated in time, and a warning."""

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import FileWarning, InputError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.spines.extract_spine import extract_spine


@pytest.fixture(scope="module")
def meshes():
    return list(creature_sequence(STARFISH, 4, resolution=32).meshes)


@pytest.fixture(scope="module")
def whole(meshes):
    return extract_spine(meshes, workers=1)


def with_frame(meshes, number, mesh):
    return [*meshes[:number], mesh, *meshes[number + 1 :]]


def two_bodies(mesh):
    away = mesh.vertices.new_tensor([4.0, 0.0, 0.0])
    return concatenate([TriangleMesh(mesh.vertices + away, mesh.faces), mesh])


@pytest.mark.parametrize("cloud", [False, True])
def test_what_the_creature_stands_on_is_left_out(meshes, whole, cloud):
    steps = torch.linspace(-2.5, 2.5, 60)
    table = torch.cartesian_prod(steps, steps, torch.zeros(1))
    corner = torch.arange(3600).reshape(60, 60)[:-1, :-1].reshape(-1, 1)
    top = TriangleMesh(table, torch.cat((corner + torch.tensor([0, 60, 1]), corner + torch.tensor([1, 60, 61]))))

    def standing(mesh):
        below = mesh.vertices.new_tensor([0.0, 0.0, float(mesh.vertices[:, 2].min()) - 0.01])
        both = concatenate([mesh, TriangleMesh(top.vertices + below, top.faces)])
        return both.vertices if cloud else both

    frames = [standing(mesh) for mesh in meshes]
    with pytest.warns(FileWarning, match=r"14\d\d\d points in 4 of 4 frames lie on the plane") as told:
        spine = extract_spine(frames, workers=1)
    assert len(told) == 1
    apart = torch.cdist(spine.tips, whole.tips)
    assert spine.num_tips == 5
    assert float(apart.amin(2).max()) < 0.2
    with pytest.raises(InputError, match="support must be"):
        extract_spine(meshes, support="cut")


@pytest.mark.parametrize("growing", [False, True])
def test_a_frame_with_two_bodies_is_passed_over(meshes, whole, growing):
    spine = extract_spine(with_frame(meshes, 1, two_bodies(meshes[1])), growing=growing, workers=1)
    assert len(spine.warnings) == 1
    assert spine.warnings[0].startswith("frame 1: passed over: ")
    assert "another body left out, with 100% of the area" in spine.warnings[0]
    assert spine.found.all(1).tolist() == [True, False, True, True]
    assert not bool(spine.own[1].any())
    assert [status.value for status in spine.statuses] == ["converged", "with_warnings", "converged", "converged"]
    assert len(spine.model.times) == len(spine.topologies) == 4
    # In between, where the tips move on evenly; the other frames are as they were.
    near = torch.cdist(spine.tips, whole.tips).amin(-1)
    assert float(near[[0, 2, 3]].max()) < 1e-5
    assert float(near[1].max()) < 0.1


def test_frames_keep_their_times_and_numbers(meshes):
    times = torch.tensor([0.0, 1.0, 4.0, 5.0])
    for frame in (0, 3):
        odd = with_frame(meshes, frame, two_bodies(meshes[frame]))
        spine = extract_spine(odd, times=times, growing=True, workers=1)
        assert torch.equal(spine.times, times)
        near = 1 if frame == 0 else 2
        torch.testing.assert_close(spine.tips[frame], spine.tips[near])
        assert (spine.births.unique().tolist(), spine.ends.unique().tolist()) == ([int(frame == 0)], [3 - (frame == 3)])


def test_two_bodies_in_most_frames_are_told_and_the_larger_ones_followed(meshes):
    spine = extract_spine([two_bodies(mesh) for mesh in meshes[:2]], workers=1)
    assert spine.num_tips == 5
    assert all("another body left out" in warning or "fragment" in warning for warning in spine.warnings)


def test_a_flat_frame_is_passed_over(meshes):
    flat = TriangleMesh(2 * torch.eye(3), torch.tensor([[0, 1, 2]]))
    spine = extract_spine(with_frame(meshes, 2, flat), workers=1)
    assert "frame 2: passed over: " in spine.warnings[0]
    assert bool(spine.curves.isfinite().all())


@pytest.mark.parametrize("growing", [False, True])
def test_another_unit_is_an_error_that_names_the_frame(meshes, growing):
    millimetres = TriangleMesh(1000 * meshes[3].vertices, meshes[3].faces)
    with pytest.raises(InputError, match=r"must be in one unit: meshes\[3\] is .* times as large as .* scale it"):
        extract_spine(with_frame(meshes, 3, millimetres), growing=growing, workers=1)


def test_few_points_are_an_error_and_repeated_ones_are_none(meshes):
    with pytest.raises(InputError, match=r"meshes\[1\] must hold 100 different points or more, got 20"):
        extract_spine(with_frame(meshes, 1, meshes[1].vertices[:20].repeat(50, 1)), workers=1)
