"""Spines of clouds without faces: near those of meshes, whatever the order of points; what is uncertain is said."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import seeded
from tests.spines.bodies import STAR, nearest_arms, random, shuffled
from torchreg.geometry.mesh import sample_surface
from torchreg.spines.frames import frame_surfaces


def noisy_points(mesh, count, seed=0):
    points = sample_surface(mesh, count, seeded(seed))[0]
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    return points + 0.002 * diagonal * random(*points.shape, seed=seed).to(points)


@pytest.fixture(scope="module")
def clouds(starfish):
    return [noisy_points(mesh, 3000, seed) for seed, mesh in enumerate(starfish.meshes[:3])]


def test_a_spine_of_clouds_has_the_tips_of_the_body(starfish, clouds):
    found = tr.extract_spine([*clouds, *starfish.meshes[3:]], workers=1)
    assert set(found.topologies) == {STAR}
    arm, distance = nearest_arms(found, starfish)
    assert bool((arm == arm[0]).all())
    assert float(distance.max()) < 0.02 * float((clouds[0].amax(0) - clouds[0].amin(0)).norm())
    assert bool((found.confidence > 0.9).all())


def test_processes_give_the_surfaces_that_one_gives_and_kept_ones_are_not_made_again(
    clouds, meshes, tmp_path, monkeypatch
):
    many = [*clouds, clouds[0] * torch.tensor([1.0, 1.0, 0.0]), meshes[0]]
    make = frame_surfaces.FrameSurfaces.of_frames
    alone, shared = make(many, workers=1), make(many, workers=2, progress=tmp_path)

    def fails(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(frame_surfaces, "as_surface", fails)
    kept = make(many, workers=1, progress=tmp_path)
    for found in (shared, kept):
        assert all(torch.equal(a.vertices, b.vertices) for a, b in zip(found, alone, strict=True))
        assert all(torch.equal(a.faces, b.faces) for a, b in zip(found, alone, strict=True))
        assert all(torch.equal(*pair) for pair in zip(found.samples, alone.samples, strict=True))
        assert found.notes == alone.notes
        assert found.notes[3]
        assert sorted(found.made) == [0, 1, 2, 3]
    with pytest.raises(AssertionError, match="made again"):
        make([clouds[0] + 1], workers=1, progress=tmp_path)


def test_order_and_repetition_of_points_change_nothing(clouds):
    plain = tr.skeletonize(clouds[0])
    twice = torch.cat((clouds[0], clouds[0][:50]))
    other = tr.skeletonize(tr.RangeScan(twice[shuffled(len(twice), 1)]))
    assert not plain.notes
    assert other.topology == plain.topology
    torch.testing.assert_close(other.nodes, plain.nodes, atol=1e-5, rtol=0)


def test_one_side_of_a_body_and_joined_gaps_are_noted(starfish, clouds):
    points, curve = clouds[0], starfish.curves[0, 1]
    for side in (points[points[:, 2] > points[:, 2].median()], random(500, 3) * torch.tensor([1.0, 1.0, 0.0])):
        assert any("do not enclose a body" in note for note in tr.skeletonize(side).notes)
    cut = tr.skeletonize(points[(points - curve[len(curve) // 2]).norm(dim=-1) > 0.2])
    assert any("joined across gaps" in note for note in cut.notes)
    assert len(cut.tips) == 5
