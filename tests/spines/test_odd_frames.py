"""Frames that do not fit a sequence: errors that name them, or limbs interpolated in time, and a warning."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import sheet_faces
from tests.spines.bodies import MeshesOnRequest
from torchreg.geometry.mesh import concatenate


def with_frame(meshes, number, mesh):
    return [*meshes[:number], mesh, *meshes[number + 1 :]]


def two_bodies(mesh):
    away = mesh.vertices.new_tensor([4.0, 0.0, 0.0])
    return concatenate([tr.TriangleMesh(mesh.vertices + away, mesh.faces), mesh])


@pytest.mark.parametrize("cloud", [False, True])
def test_what_the_creature_stands_on_is_left_out(meshes, spine, cloud):
    steps = torch.linspace(-2.5, 2.5, 60)
    table = torch.cartesian_prod(steps, steps, torch.zeros(1))

    def standing(mesh):
        below = mesh.vertices.new_tensor([0.0, 0.0, float(mesh.vertices[:, 2].min()) - 0.01])
        both = concatenate([mesh, tr.TriangleMesh(table + below, sheet_faces(60, 60))])
        return both.vertices if cloud else both

    with pytest.warns(tr.errors.FileWarning, match=r"14\d\d\d points in 4 of 4 frames lie on the plane") as warned:
        found = tr.extract_spine([standing(mesh) for mesh in meshes], workers=1)
    assert len(warned) == 1
    assert found.num_tips == 5
    assert float(torch.cdist(found.tips, spine.tips).amin(2).max()) < 0.2


@pytest.mark.parametrize("growing", [False, True])
def test_a_frame_with_two_bodies_is_passed_over(meshes, spine, growing):
    found = tr.extract_spine(with_frame(meshes, 1, two_bodies(meshes[1])), growing=growing, workers=1)
    assert len(found.warnings) == 1
    assert found.warnings[0].startswith("frame 1: passed over: ")
    assert "another body left out, with 100% of the area" in found.warnings[0]
    assert found.found.all(1).tolist() == [True, False, True, True]
    assert not bool(found.own[1].any())
    assert [status.value for status in found.statuses] == ["converged", "with_warnings", "converged", "converged"]
    assert len(found.model.times) == len(found.topologies) == 4
    # In between, where the tips move on evenly; the other frames are as they were.
    near = torch.cdist(found.tips, spine.tips).amin(-1)
    assert float(near[[0, 2, 3]].max()) < 1e-5
    assert float(near[1].max()) < 0.1


@pytest.mark.parametrize("frame", [0, 3])
def test_frames_keep_their_times_and_numbers(meshes, frame):
    times = torch.tensor([0.0, 1.0, 4.0, 5.0])
    odd = with_frame(meshes, frame, two_bodies(meshes[frame]))
    found = tr.extract_spine(odd, times=times, growing=True, workers=1)
    assert torch.equal(found.times, times)
    torch.testing.assert_close(found.tips[frame], found.tips[1 if frame == 0 else 2])
    assert (found.births.unique().tolist(), found.ends.unique().tolist()) == ([int(frame == 0)], [3 - (frame == 3)])


def test_of_two_bodies_in_most_frames_the_larger_one_is_followed(meshes):
    found = tr.extract_spine([two_bodies(mesh) for mesh in meshes[:2]], workers=1)
    assert found.num_tips == 5
    assert all("another body left out" in warning or "fragment" in warning for warning in found.warnings)


def test_a_flat_frame_is_passed_over_also_far_from_the_origin(meshes, spine):
    shift = 4.0e6
    moved = [tr.TriangleMesh(mesh.vertices.double() + shift, mesh.faces) for mesh in meshes]
    flat = tr.TriangleMesh(moved[2].vertices * torch.tensor([1.0, 1, 0]), moved[2].faces)
    found = tr.extract_spine(MeshesOnRequest(with_frame(moved, 2, flat)), workers=1)
    assert any(warning.startswith("frame 2: passed over") for warning in found.warnings)
    assert found.curves.shape == spine.curves.shape
    assert bool(found.curves.isfinite().all())
    middle = found.curves.double().mean((0, 1, 2)) - spine.curves.double().mean((0, 1, 2)) - shift
    assert float(middle.norm()) < 0.05 * float(spine.curves.amax() - spine.curves.amin())


@pytest.mark.parametrize("growing", [False, True])
def test_another_unit_is_an_error_that_names_the_frame(meshes, growing):
    millimeters = tr.TriangleMesh(1000 * meshes[3].vertices, meshes[3].faces)
    words = r"must be in one unit: meshes\[3\] is .* times as large as .* scale it"
    with pytest.raises(tr.errors.InputError, match=words):
        tr.extract_spine(with_frame(meshes, 3, millimeters), growing=growing, workers=1)
