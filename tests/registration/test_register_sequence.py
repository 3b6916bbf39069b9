"""Many scans together: every frame reached, one set of weights, all points in one pose, bad input."""

import math
import sys
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.registration.bones.alternation import ReducedFit
from torchreg.registration.config import RegisterConfig
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.normalization import Normalization
from torchreg.registration.register import source_samples
from torchreg.registration.register_sequence import register_sequence

QUICK = RegisterConfig(align=ScanAlignConfig(num_samples=300, num_target_samples=400), num_samples=500)


@pytest.fixture(scope="module")
def toy():
    return jointed_toy(3, seed=2, scanner=DepthScanner(num_points=700), step=math.radians(12))


@pytest.fixture(scope="module")
def found(toy):
    return register_sequence([toy[frame] for frame in range(3)], 8, 30, QUICK, reference=1)


def test_every_frame_is_reached_from_the_reference(toy, found):
    assert found.deformed.shape == (3, len(toy[1]), 3)
    assert found.transforms.shape[0] == 3
    for frame in range(3):
        errors = (found.deformed[frame] - toy.truth(1, frame)).norm(dim=-1) / toy[1].diagonal
        assert float((errors < 0.025).float().mean()) > 0.85
    with torch.no_grad():
        torch.testing.assert_close(found.model(found.points), found.deformed, atol=1e-4, rtol=0)
    assert found.status.usable


def test_the_reference_stays_where_it_is(toy, found):
    assert float((found.deformed[1] - found.points).norm(dim=-1).mean()) < 0.005 * toy[1].diagonal


def test_all_points_meet_in_the_pose_of_the_reference(toy, found):
    assert len(found.fused) == sum(len(toy[frame]) for frame in range(3))
    assert found.fused_frames.unique().tolist() == [0, 1, 2]
    torch.testing.assert_close(found.fused_normals.norm(dim=-1), torch.ones(len(found.fused)))
    distance = nearest_neighbor(found.fused, toy[1].points)[1] / toy[1].diagonal
    assert float(distance.median()) < 0.01


def test_results_are_the_same_on_disk(found, tmp_path):
    found.save(tmp_path / "all.safetensors")
    back = tr.load(tmp_path / "all.safetensors")
    for name in ("deformed", "transforms", "weights", "fused", "fused_frames"):
        assert torch.equal(getattr(back, name), getattr(found, name))
    assert back.history == found.history


def test_points_are_expected_to_go_on_as_they_went(toy, monkeypatch):
    calls = []

    def watched(source, target, config, **options):
        aligned = align_scans(source, target, config, **options)
        calls.append((source.points, options["expected"]))
        return aligned

    # The package has a function of the module's name.
    monkeypatch.setattr(sys.modules[register_sequence.__module__], "align_scans", watched)
    register_sequence([toy[frame] for frame in (0, 1, 2, 1)], 8, 30, QUICK, reference=1)
    (first, nothing), (second, ahead), (third, back) = calls
    assert nothing is None
    assert torch.equal(first, toy[1].points)
    torch.testing.assert_close(ahead, second + 0.5 * (second - first))
    # Towards earlier frames, against the way that later ones were reached.
    assert torch.equal(third, first)
    torch.testing.assert_close(back, first - 0.5 * (second - first))


@pytest.mark.parametrize(
    ("given", "carried"),
    [
        ({"point_to_point": 0.01, "joint_weight": (0.001, 0.001)}, (0.1, (1e-4, 1e-4))),
        ({"point_to_point": 0.5, "joint_weight": (1e-5, 1e-6)}, (0.5, (1e-5, 1e-6))),
        ({"joint_weight": (0.0, 0.0)}, (0.1, (0.0, 0.0))),
    ],
)
def test_what_is_carried_is_held_along_the_surface_and_not_by_joints(toy, monkeypatch, given, carried):
    settings = []

    def watched(source, target, num_bones, grid_resolution, config, generator, **start):
        settings.append((config.point_to_point, config.joint_weight))
        return tr.register(source, target, num_bones, grid_resolution, config, generator, **start)

    monkeypatch.setattr(sys.modules[register_sequence.__module__], "register", watched)
    register_sequence([toy[0], toy[1], toy[2]], 8, 30, replace(QUICK, **given))
    assert settings == [carried]


@pytest.mark.parametrize(
    ("given", "held"),
    [
        ({}, {"turn_scale": 0.5, "joint_weight": (0.01, 0.01), "point_to_point": 0.001, "seam_cap": 1.0}),
        ({"turn_scale": 2.0, "joint_weight": (1.0, 0.05)}, {"turn_scale": 2.0, "joint_weight": (1.0, 0.05)}),
        ({"joint_weight": (0.0, 0.0), "num_patches": 300}, {"joint_weight": (0.0, 0.0), "num_patches": 300}),
        ({}, {"match_steps": 4, "refine_steps": 3, "settle_steps": 4, "rtol": 0.02}),
        ({"match_steps": 6, "refine_steps": 0, "rtol": 0.0}, {"match_steps": 6, "refine_steps": 0, "rtol": 0.0}),
    ],
)
def test_all_frames_are_fitted_to_the_dense_alignments_and_bones_hold_each_other(toy, monkeypatch, given, held):
    module, reached, fits = sys.modules[register_sequence.__module__], [], []

    def aligned(*arguments, **options):
        reached.append(align_scans(*arguments, **options))
        return reached[-1]

    class Watched(ReducedFit):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            fits.append(self)

    monkeypatch.setattr(module, "align_scans", aligned)
    monkeypatch.setattr(module, "ReducedFit", Watched)
    config = replace(QUICK, **given)
    register_sequence([toy[0], toy[1], toy[2]], 8, 30, config)
    assert {name: getattr(fits[0].config, name) for name in held} == held
    assert fits[0].data.linked
    index = source_samples(toy[0], config, None)
    unit = Normalization.from_points(toy[0].points[index])
    expected = torch.stack([unit.normalize(points)[index] for points in (toy[0].points, *(r.points for r in reached))])
    torch.testing.assert_close(fits[0].samples.moved, expected)


def test_bad_arguments_are_refused_by_name(toy):
    with pytest.raises(InputError, match="scans must hold at least two"):
        register_sequence([toy[0]])
    with pytest.raises(InputError, match="reference must be below"):
        register_sequence([toy[0], toy[1]], reference=2)
    with pytest.raises(InputTypeError, match="RangeScan"):
        register_sequence([toy[0], toy[1].points])
