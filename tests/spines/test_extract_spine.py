"""Spines of sequences that share nothing against the truth, on unsound data, in several processes and in two calls."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import STAR, MeshesOnRequest, moved, nearest_arms, random, similarity, without_arm
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.mesh import concatenate, unit_sphere
from torchreg.spines.frames import frame_skeletons

BALL = unit_sphere(1)
EMPTY = tr.TriangleMesh(torch.zeros(0, 3), torch.zeros(0, 3).long())


@pytest.fixture(scope="module")
def touching():
    return creature_sequence(STARFISH, 6, touching="flanks", resolution=40)


@pytest.fixture(scope="module")
def extracted(touching):
    return tr.extract_spine(touching.meshes)


def test_one_graph_with_named_tips_also_where_arms_touch(extracted, touching):
    assert extracted.num_tips == 5
    assert set(extracted.topologies) == {STAR}
    assert extracted.curves.shape == (6, 5, 24, 3)
    arm, distance = nearest_arms(extracted, touching)
    assert bool((arm == arm[0]).all())
    assert float(distance.max()) < 0.15
    assert float((extracted.junctions[:, 0] - touching.curves[:, 0, 0]).norm(dim=-1).max()) < 0.08
    assert extracted.own_topologies.count(STAR) >= 3


def test_the_status_says_which_limbs_were_transferred(extracted, touching):
    for frame, complete in enumerate((extracted.own.all(1) & extracted.found.all(1)).tolist()):
        if not complete:
            assert extracted.statuses[frame] is tr.Status.WITH_WARNINGS
            assert any(warning.startswith(f"frame {frame}: ") for warning in extracted.warnings)
    assert extracted.status.usable
    assert bool(extracted.own[~touching.touching].all())


def test_the_model_plays_between_frames_and_is_saved(spine, tmp_path):
    torch.testing.assert_close(spine.model(spine.times), spine.curves)
    motion = (spine.curves[1] - spine.curves[2]).norm(dim=-1)
    assert bool(((spine.model(0.15) - spine.curves[1]).norm(dim=-1) < motion + 1e-3).all())
    torch.testing.assert_close(spine.model.frames(0.1), spine.frames[1], atol=1e-4, rtol=0)
    assert spine.confidence.shape == spine.found.shape
    assert bool(((spine.confidence > 0.5) & (spine.confidence <= 1)).all())
    spine.save(tmp_path / "a.safetensors")
    again = tr.load(tmp_path / "a.safetensors")
    assert torch.equal(again.curves, spine.curves)
    assert torch.equal(again.confidence, spine.confidence)
    assert torch.equal(again.model(0.21), spine.model(0.21))


def test_motion_and_scale_change_nothing_but_coordinates(meshes):
    matrix = similarity(0, 250.0)
    plain = tr.extract_spine(meshes[:2])
    again = tr.extract_spine([tr.TriangleMesh(moved(m.vertices.double(), matrix), m.faces) for m in meshes[:2]])
    torch.testing.assert_close(again.curves, moved(plain.curves.double(), matrix), rtol=0, atol=250 * 2e-2)
    assert again.topologies == plain.topologies


def test_a_single_frame_is_a_spine_that_stands_still(meshes):
    found = tr.extract_spine(meshes[:1])
    assert found.topologies == (STAR,)
    assert found.status is tr.Status.CONVERGED
    torch.testing.assert_close(found.model(0.0), found.curves[0])


def test_missing_limbs_fragments_holes_wrong_winding_and_noise_are_borne(starfish):
    meshes = list(creature_sequence(STARFISH, 5, resolution=40, noise=0.3).meshes)
    meshes[0] = concatenate([meshes[0], tr.TriangleMesh(0.03 * BALL.vertices + 1.5, BALL.faces)])
    meshes[1] = tr.TriangleMesh(meshes[1].vertices, meshes[1].faces.flip(1))
    meshes[2] = without_arm(starfish, 2, 1)
    meshes[3] = tr.TriangleMesh(meshes[3].vertices, meshes[3].faces[40:])
    found = tr.extract_spine(meshes)
    arm, _ = nearest_arms(found, starfish)
    assert set(found.topologies) == {STAR}
    assert bool((arm == arm[0])[found.found].all())
    assert not bool(found.own[2].all())
    assert found.status is tr.Status.WITH_WARNINGS
    assert any("fragment" in warning for warning in found.warnings)
    assert any(warning.startswith("frame 2: ") for warning in found.warnings)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda _: tr.extract_spine([]), "InputError", "meshes must hold at least one frame"),
        (lambda _: tr.extract_spine(MeshesOnRequest([])), "InputError", "meshes must hold at least one frame"),
        (lambda _: tr.extract_spine(BALL), "InputTypeError", "got one mesh; put it into a list"),
        (lambda _: tr.extract_spine([BALL, "x"]), "InputTypeError", r"meshes\[1\] must be a TriangleMesh, got str"),
        (lambda _: tr.extract_spine(MeshesOnRequest([BALL, EMPTY])), "InputError", r"meshes\[1\] must have faces"),
        (lambda _: tr.extract_spine([BALL, random(20, 3).repeat(10, 1)]), "InputError", r"\[1\] must hold 100 .* 20"),
        (lambda _: tr.extract_spine([BALL], workers=0), "InputError", "workers must be at least 1"),
        (lambda _: tr.extract_spine([BALL], support="cut"), "InputError", "support must be"),
        (lambda _: tr.SpineConfig(num_tips=1), "InputError", "num_tips must be at least 2"),
        (lambda _: tr.SpineConfig(num_samples=2), "InputError", "num_samples must be at least 3"),
        (lambda m: tr.extract_spine(m, config=tr.SpineConfig(num_tips=7)), "InputError", "shows, 5 at most, got 7"),
        (lambda m: tr.extract_spine(m, times=torch.arange(2.0)), "InputError", "times must have shape"),
    ],
)
def test_bad_input_is_named(meshes, call, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        call(meshes[:1])


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_frame(meshes, workers):
    flat = tr.TriangleMesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(tr.errors.InputError, match=r"meshes\[3\]: "):
        tr.extract_spine([*meshes[:3], flat], workers=workers)


def test_several_processes_give_what_one_gives(meshes, spine):
    records = []
    shared = tr.extract_spine(meshes, workers=2, on_step=records.append)
    assert torch.equal(shared.curves, spine.curves)
    assert torch.equal(shared.radii, spine.radii)
    assert sorted(record.frame for record in records) == [0, 1, 2, 3]
    assert {(record.num_frames, record.num_tips, record.topology) for record in records} == {(4, 5, STAR)}
    assert all(record.seconds > 0 for record in records)


def test_surfaces_on_request_are_never_held_as_a_whole(meshes, spine):
    on_request = MeshesOnRequest(meshes)
    found = tr.extract_spine(on_request, workers=1)
    assert on_request.most <= 2
    assert on_request.asked <= 3 * len(meshes)
    torch.testing.assert_close(found.curves, spine.curves)


def test_skeletons_that_were_kept_are_not_computed_again(meshes, spine, tmp_path):
    folder = tmp_path / "kept"

    def stop(record):
        if record.frame == 1:
            raise KeyboardInterrupt

    def computed(meshes, **options):
        records = []
        found = tr.extract_spine(meshes, workers=1, on_step=records.append, progress=folder, **options)
        return found, [record.seconds > 0 for record in sorted(records, key=lambda record: record.frame)]

    with pytest.raises(KeyboardInterrupt):
        tr.extract_spine(meshes, workers=1, on_step=stop, progress=folder)
    assert len(list(folder.glob("*.safetensors"))) == 2
    found, again = computed(meshes)
    assert again == [False, False, True, True]
    assert torch.equal(found.curves, spine.curves)
    damaged = folder / "frame_00002.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-7])
    found, again = computed(meshes)
    assert again == [False, False, True, False]
    assert torch.equal(found.curves, spine.curves)
    finer = tr.SpineConfig(skeletons=tr.SkeletonizeConfig(num_levels=80))
    assert computed(meshes[:2], config=finer)[1] == [True, True]
    assert computed(meshes[1:2])[1] == [True]


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced_once(meshes, spine, monkeypatch, tmp_path):
    parent, plain, once = os.getpid(), frame_skeletons.skeletonize_surface, tmp_path / "died"

    def dies(mesh, config, always=False):
        if os.getpid() != parent and (always or not once.exists()):
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return plain(mesh, config)

    monkeypatch.setattr(frame_skeletons, "skeletonize_surface", dies)
    assert torch.equal(tr.extract_spine(meshes, workers=2).curves, spine.curves)
    assert once.exists()
    monkeypatch.setattr(frame_skeletons, "skeletonize_surface", lambda *inputs: dies(*inputs, always=True))
    with pytest.raises(tr.errors.SolverError, match=r"was killed twice.*pass workers=1"):
        tr.extract_spine(meshes, workers=2)


def test_two_threads_get_their_own_skeletons(meshes):
    halves = [meshes[:2], meshes[2:]]
    alone = [tr.extract_spine(half, workers=1).curves for half in halves]
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda half: tr.extract_spine(half, workers=2).curves, halves))
    assert all(torch.equal(*pair) for pair in zip(alone, both, strict=True))
