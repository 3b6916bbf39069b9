"""Spines of sequences that share nothing against the truth, on unsound data, in several processes and in two calls."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import InputError, InputTypeError, SolverError
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.result import Status
from torchreg.spines.extract_spine import SpineConfig, extract_spine
from torchreg.spines.frames import frame_skeletons
from torchreg.spines.results import SpineSequence
from torchreg.spines.skeletonize import SkeletonizeConfig
from torchreg.storage import load

STAR = "(()()()()())"
FRAMES = 6


@pytest.fixture(scope="module")
def touching():
    return creature_sequence(STARFISH, FRAMES, touching="flanks", resolution=40)


@pytest.fixture(scope="module")
def extracted(touching):
    return extract_spine(touching.meshes, times=torch.arange(FRAMES) / 10)


def arms(spine, sequence):
    """Which arm each tip is in each frame, (T, K), and how far they are apart."""
    distance, arm = torch.cdist(spine.tips.double(), sequence.tips.double()).min(-1)
    return arm, distance


def test_one_graph_with_named_tips_also_where_arms_touch(extracted, touching):
    assert extracted.num_tips == 5
    assert set(extracted.topologies) == {STAR}
    assert extracted.curves.shape == (FRAMES, 5, 24, 3)
    arm, distance = arms(extracted, touching)
    assert bool((arm == arm[0]).all())
    assert float(distance.max()) < 0.15
    middle = (extracted.junctions[:, 0] - touching.curves[:, 0, 0]).norm(dim=-1)
    assert float(middle.max()) < 0.08
    assert extracted.own_topologies.count(STAR) >= 0.5 * FRAMES


def test_the_status_tells_which_limbs_were_transferred(extracted, touching):
    for frame in range(FRAMES):
        clean = bool(extracted.own[frame].all()) and bool(extracted.found[frame].all())
        if not clean:
            assert extracted.statuses[frame] is Status.WITH_WARNINGS
            assert any(warning.startswith(f"frame {frame}: ") for warning in extracted.warnings)
    assert extracted.status.usable
    assert bool(extracted.own[~touching.touching].all())


def test_the_model_plays_between_frames_and_is_saved(extracted, tmp_path):
    torch.testing.assert_close(extracted.model(extracted.times), extracted.curves)
    between = extracted.model(0.15)
    motion = (extracted.curves[1] - extracted.curves[2]).norm(dim=-1)
    assert bool(((between - extracted.curves[1]).norm(dim=-1) < motion + 1e-3).all())
    torch.testing.assert_close(extracted.model.frames(0.1), extracted.frames[1], atol=1e-4, rtol=0)
    extracted.save(tmp_path / "a.safetensors")
    again = load(tmp_path / "a.safetensors")
    assert torch.equal(again.curves, extracted.curves)
    assert torch.equal(again.model(0.31), extracted.model(0.31))


def test_motion_scale_and_order_of_vertices_change_nothing_but_coordinates():
    sequence = creature_sequence(STARFISH, 2, resolution=32, dtype=torch.float64)
    turn = so3_exp(torch.tensor([0.4, 1.1, -0.6], dtype=torch.float64))

    def moved(points):
        return 250 * points @ turn.mT + torch.tensor([10.0, -500.0, 3.0], dtype=torch.float64)

    plain = extract_spine(sequence.meshes)
    again = extract_spine([TriangleMesh(moved(mesh.vertices), mesh.faces) for mesh in sequence.meshes])
    torch.testing.assert_close(again.curves, moved(plain.curves), rtol=0, atol=250 * 2e-2)
    assert again.topologies == plain.topologies


def test_a_single_frame_is_a_spine_that_stands_still():
    sequence = creature_sequence(STARFISH, 1, resolution=32)
    spine = extract_spine(sequence.meshes)
    assert spine.topologies == (STAR,)
    assert spine.status is Status.CONVERGED
    torch.testing.assert_close(spine.model(0.0), spine.curves[0])


def test_a_missing_limb_is_told_and_kept():
    sequence = creature_sequence(STARFISH, 5, resolution=32)
    mesh = sequence.meshes[2]
    away = sequence.curves[2, 1, 20] - sequence.curves[2, 1, 0]
    beyond = ((mesh.vertices - sequence.curves[2, 1, 20]) @ away > 0) & (
        (mesh.vertices - sequence.curves[2, 1, 30]).norm(dim=-1) < 0.5
    )
    cut = TriangleMesh(mesh.vertices, mesh.faces[~beyond[mesh.faces].any(-1)])
    spine = extract_spine([*sequence.meshes[:2], cut, *sequence.meshes[3:]])
    arm, _ = arms(spine, sequence)
    assert set(spine.topologies) == {STAR}
    assert bool((arm == arm[0]).all())
    assert spine.status is Status.WITH_WARNINGS
    assert any(warning.startswith("frame 2: ") for warning in spine.warnings)


def test_fragments_holes_wrong_winding_and_noise_are_borne():
    sequence = creature_sequence(STARFISH, 4, resolution=32, noise=0.3)
    ball = unit_sphere(1)
    dust = TriangleMesh(0.03 * ball.vertices + 1.5, ball.faces)
    meshes = list(sequence.meshes)
    meshes[0] = concatenate([meshes[0], dust])
    meshes[1] = TriangleMesh(meshes[1].vertices, meshes[1].faces.flip(1))
    meshes[2] = TriangleMesh(meshes[2].vertices, meshes[2].faces[40:])
    spine = extract_spine(meshes)
    arm, _ = arms(spine, sequence)
    assert set(spine.topologies) == {STAR}
    assert bool((arm == arm[0]).all())
    assert any("fragment" in warning for warning in spine.warnings)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: extract_spine([]), InputError, "meshes must hold at least one frame"),
        (lambda: extract_spine(unit_sphere(1)), InputTypeError, "put it into a list"),
        (lambda: extract_spine([unit_sphere(1), "x"]), InputTypeError, r"meshes\[1\] must be a TriangleMesh, got str"),
        (
            lambda: extract_spine([unit_sphere(1), TriangleMesh(torch.zeros(0, 3), torch.zeros(0, 3).long())]),
            InputError,
            r"meshes\[1\] must have faces",
        ),
        (lambda: extract_spine([unit_sphere(1)], workers=0), InputError, "workers must be at least 1"),
        (lambda: SpineConfig(num_tips=1), InputError, "num_tips must be at least 2"),
        (lambda: SpineConfig(num_samples=2), InputError, "num_samples must be at least 3"),
    ],
)
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_more_tips_than_any_frame_shows_are_refused():
    sequence = creature_sequence(STARFISH, 1, resolution=32)
    with pytest.raises(InputError, match="num_tips must be what a frame shows, 5 at most, got 7"):
        extract_spine(sequence.meshes, config=SpineConfig(num_tips=7))
    with pytest.raises(InputError, match="times must have shape"):
        extract_spine(sequence.meshes, times=torch.tensor([0.0, 1.0]))


@pytest.fixture(scope="module")
def meshes():
    return creature_sequence(STARFISH, 4, resolution=32).meshes


@pytest.fixture(scope="module")
def alone(meshes):
    return extract_spine(meshes, workers=1)


def test_several_processes_give_what_one_gives(meshes, alone):
    records = []
    shared = extract_spine(meshes, workers=2, on_step=records.append)
    assert torch.equal(shared.curves, alone.curves)
    assert torch.equal(shared.radii, alone.radii)
    assert sorted(record.frame for record in records) == [0, 1, 2, 3]
    assert {(record.num_frames, record.num_tips, record.topology) for record in records} == {(4, 5, STAR)}
    assert all(record.seconds > 0 for record in records)


def test_skeletons_that_were_kept_are_not_computed_again(meshes, alone, tmp_path):
    folder = tmp_path / "kept"

    def stop(record):
        if record.frame == 1:
            raise KeyboardInterrupt

    def computed(meshes, **options):
        records = []
        spine = extract_spine(meshes, workers=1, on_step=records.append, progress=folder, **options)
        return spine, [record.seconds > 0 for record in sorted(records, key=lambda record: record.frame)]

    with pytest.raises(KeyboardInterrupt):
        extract_spine(meshes, workers=1, on_step=stop, progress=folder)
    assert len(list(folder.glob("*.safetensors"))) == 2
    assert computed(meshes)[1] == [False, False, True, True]
    spine, again = computed(meshes)
    assert not any(again)
    assert torch.equal(spine.curves, alone.curves)
    damaged = folder / "frame_00002.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-7])
    spine, again = computed(meshes)
    assert again == [False, False, True, False]
    assert torch.equal(spine.curves, alone.curves)
    finer = SpineConfig(skeletons=SkeletonizeConfig(num_levels=80))
    assert computed(meshes[:2], config=finer)[1] == [True, True]
    assert computed(meshes[1:2])[1] == [True]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_frame(meshes, workers):
    flat = TriangleMesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"meshes\[3\]: "):
        extract_spine([*meshes[:3], flat], workers=workers)


def sequence(graph, curves, num_tips):
    num_frames, num_limbs = curves.shape[:2]
    return SpineSequence(
        model=torch.nn.Identity(), graph=graph, curves=curves, radii=torch.ones(curves.shape[:3]),
        frames=torch.eye(3).expand(*curves.shape[:3], 3, 3), times=torch.arange(float(num_frames)),
        found=torch.ones(num_frames, num_tips, dtype=torch.bool),
        own=torch.ones(num_frames, num_limbs, dtype=torch.bool), reference=0, topologies=("",) * num_frames,
        own_topologies=("",) * num_frames, statuses=(Status.CONVERGED,) * num_frames, status=Status.CONVERGED,
        warnings=(),
    )  # fmt: skip


def test_tips_are_where_limbs_start_and_junctions_where_they_meet():
    # An H: four tips, two junctions, the bar last.
    positions = torch.tensor([[0.0, 1], [0, -1], [2, 1], [2, -1], [0, 0], [2, 0]])
    graph = torch.tensor([[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]])
    ends = torch.nn.functional.pad(positions, (0, 1))[graph]
    steps = torch.linspace(0, 1, 4)[:, None]
    curve = torch.lerp(ends[:, :1], ends[:, 1:], steps)
    curves = torch.stack((curve, curve + torch.tensor([0.0, 0, 5])))
    found = sequence(graph, curves, num_tips=4)
    assert found.num_tips == 4
    torch.testing.assert_close(found.tips[..., :2], positions[:4].expand(2, 4, 2))
    torch.testing.assert_close(found.junctions[..., :2], positions[4:].expand(2, 2, 2))
    assert found.junctions[..., 2].unique().tolist() == [0, 5]


def test_a_single_limb_has_no_junction():
    curves = torch.rand(3, 2, 4, 3, generator=torch.Generator().manual_seed(0))[:, :1]
    found = sequence(torch.tensor([[0, 1]]), curves, num_tips=2)
    assert found.junctions.shape == (3, 0, 3)


def test_a_worker_that_is_killed_is_replaced_once(meshes, monkeypatch, tmp_path):
    here, plain = os.getpid(), frame_skeletons.skeletonize_surface

    def dies(mesh, config):
        if os.getpid() != here and not (tmp_path / "died").exists():
            (tmp_path / "died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return plain(mesh, config)

    alone = extract_spine(meshes, workers=1)
    monkeypatch.setattr(frame_skeletons, "skeletonize_surface", dies)
    assert torch.equal(extract_spine(meshes, workers=2).curves, alone.curves)
    assert (tmp_path / "died").exists()

    def always_dies(mesh, config):
        os.kill(os.getpid(), signal.SIGKILL) if os.getpid() != here else None
        return plain(mesh, config)

    monkeypatch.setattr(frame_skeletons, "skeletonize_surface", always_dies)
    with pytest.raises(SolverError, match=r"was killed twice.*pass workers=1"):
        extract_spine(meshes, workers=2)


def test_two_threads_get_their_own_skeletons(meshes):
    halves = [meshes, meshes[::-1]]
    alone = [extract_spine(half, workers=1).curves for half in halves]
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda half: extract_spine(half, workers=2).curves, halves))
    assert all(torch.equal(*pair) for pair in zip(alone, both, strict=True))
