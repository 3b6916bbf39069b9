"""Spines of clouds without faces: near those of meshes, whatever the order of points; what cannot be told is said."""

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import InputError
from torchreg.geometry.cloud_surface import cloud_surface
from torchreg.geometry.mesh import sample_surface, unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.spines.extract_spine import extract_spine
from torchreg.spines.frames import frame_surfaces
from torchreg.spines.frames.frame_surfaces import FrameSurfaces
from torchreg.spines.skeletonize import skeletonize


def noisy_points(mesh, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = sample_surface(mesh, count, generator)[0]
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    return points + 0.002 * diagonal * torch.randn(points.shape, generator=generator, dtype=points.dtype)


@pytest.fixture(scope="module")
def starfish():
    return creature_sequence(STARFISH, 3, resolution=40)


@pytest.fixture(scope="module")
def clouds(starfish):
    return [noisy_points(mesh, 3000, seed) for seed, mesh in enumerate(starfish.meshes)]


def test_the_surface_around_points_of_a_ball_is_a_ball():
    points = noisy_points(unit_sphere(4, dtype=torch.float64), 4000)
    found = cloud_surface(points)
    distance = found.mesh.vertices.norm(dim=-1)
    assert found.encloses
    assert found.mesh.vertices.dtype == points.dtype
    assert float(distance.mean()) == pytest.approx(1.04, abs=0.04)
    assert float((distance - distance.mean()).abs().max()) < 0.08


def test_a_spine_of_clouds_has_the_tips_of_the_body(starfish, clouds):
    spine = extract_spine(clouds, workers=1)
    assert set(spine.topologies) == {starfish.topology}
    distance, arm = torch.cdist(spine.tips, starfish.tips).min(-1)
    assert bool((arm == arm[0]).all())
    assert float(distance.max()) < 0.02 * float((clouds[0].amax(0) - clouds[0].amin(0)).norm())
    assert bool((spine.confidence > 0.9).all())


def test_processes_give_the_surfaces_that_one_gives(clouds):
    many = [*clouds, clouds[0][::2], creature_sequence(STARFISH, 1, resolution=32).meshes[0]]
    alone, shared = (FrameSurfaces.of_frames(many, workers=workers) for workers in (1, 2))
    for number in range(len(many)):
        assert torch.equal(shared[number].vertices, alone[number].vertices)
        assert torch.equal(shared[number].faces, alone[number].faces)
    assert all(torch.equal(*pair) for pair in zip(shared.samples, alone.samples, strict=True))
    assert shared.notes == alone.notes
    assert sorted(shared.made) == [0, 1, 2, 3]


def test_surfaces_that_were_kept_are_not_made_again(clouds, tmp_path, monkeypatch):
    flat = clouds[0] * torch.tensor([1.0, 1.0, 0.0])
    first = FrameSurfaces.of_frames([*clouds, flat], workers=2, progress=tmp_path)

    def fails(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(frame_surfaces, "as_surface", fails)
    again = FrameSurfaces.of_frames([*clouds, flat], workers=1, progress=tmp_path)
    assert all(torch.equal(first[number].vertices, again[number].vertices) for number in range(4))
    assert again.notes == first.notes
    assert again.notes[3]
    with pytest.raises(AssertionError, match="made again"):
        FrameSurfaces.of_frames([clouds[0] + 1], workers=1, progress=tmp_path)


def test_order_and_repetition_of_points_change_nothing(clouds):
    order = torch.randperm(len(clouds[0]), generator=torch.Generator().manual_seed(1))
    plain = skeletonize(clouds[0])
    other = skeletonize(RangeScan(torch.cat((clouds[0], clouds[0][:50]))[order]))
    assert other.topology == plain.topology
    torch.testing.assert_close(other.nodes, plain.nodes, atol=1e-5, rtol=0)


def test_one_side_of_a_body_is_told_as_that(clouds):
    points = clouds[0]
    front = points[points[:, 2] > points[:, 2].median()]
    assert any("do not enclose a body" in note for note in skeletonize(front).notes)
    assert not skeletonize(points).notes


def test_a_plane_of_points_is_told_as_one_side():
    plane = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.0])
    assert any("do not enclose a body" in note for note in skeletonize(plane).notes)


def test_a_limb_that_a_hole_cuts_is_joined_and_told(starfish, clouds):
    tips, curves = starfish.tips[0], starfish.curves[0]
    cut = curves[1, curves.shape[1] // 2]
    holed = clouds[0][(clouds[0] - cut).norm(dim=-1) > 0.2]
    found = skeletonize(holed)
    assert any("joined across gaps" in note for note in found.notes)
    assert len(found.tips) == len(tips)


def test_few_points_are_refused(clouds):
    with pytest.raises(InputError, match=r"meshes\[1\] must hold 100 different points or more, got 20"):
        extract_spine([clouds[0], clouds[1][:20].repeat(10, 1)])
    with pytest.raises(InputError, match="mesh must"):
        skeletonize(torch.full((200, 3), torch.nan))
