"""The grid's bones as a module to train: projected weights, and a state that holds all of the model."""

import pytest
import safetensors.torch
import torch

import torchreg as tr
from tests.geometry.draws import randn
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.solvers.simplex import nearest_on_simplex

POINTS = randn(20, 3, seed=1) * torch.tensor([3.0, 0.5, 0.4])


InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError
BLENDS = pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
GRID = ("grid_cells", "grid_shape", "grid_origin", "grid_axes", "grid_spacing", "blend_number")


def random_model(blend="linear", seed=0):
    grid = SparseGrid.from_points(randn(200, 3, seed=seed) * torch.tensor([3.0, 0.5, 0.4]), 7)
    model = tr.GridLBS(grid, randn(grid.num_corners, 3).abs(), se3_exp(0.7 * randn(2, 3, 6)), blend=blend)
    with torch.no_grad():
        model.twists.add_(0.2 * randn(2, 3, 6, seed=1))
    return model


def fresh_model(model):
    return tr.GridLBS(model.grid, torch.ones_like(model.weights), torch.eye(4).double().repeat(2, 3, 1, 1))


def test_projected_rows_are_the_nearest_of_the_simplex():
    model = random_model()
    with torch.no_grad():
        model.weights.copy_(randn(*model.weights.shape, seed=2))
        expected, parameter = nearest_on_simplex(model.weights), model.weights
    assert model.project_() is model
    assert model.weights is parameter
    torch.testing.assert_close(model.weights.detach(), expected)
    assert bool(model(POINTS).isfinite().all())


def test_weights_that_are_not_finite_are_refused():
    model = random_model()
    with torch.no_grad():
        model.weights[3, 1] = torch.nan
        model.weights[5] = torch.inf
    with pytest.raises(InputError, match=r"weights must be finite, got 4 non-finite of .*; take smaller steps"):
        model.project_()
    assert bool(model.weights[3, 1].isnan())


@BLENDS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_state_gives_the_model_back(tmp_path, blend, dtype):
    model, points = random_model(blend).to(dtype), POINTS.to(dtype)
    assert [name for name, value in model.named_parameters()] == ["weights", "twists"]
    safetensors.torch.save_file(model.state_dict(), tmp_path / "model.safetensors")
    for state in (model.state_dict(), safetensors.torch.load_file(tmp_path / "model.safetensors")):
        again = tr.GridLBS.from_state_dict(state)
        assert (again.blend, again.weights.dtype) == (blend, dtype)
        assert torch.equal(again(points), model(points))
        for name, value in model.state_dict().items():
            assert torch.equal(again.state_dict()[name], value), name
        assert (again.grid.shape, again.grid.spacing) == (model.grid.shape, model.grid.spacing)
        assert torch.equal(again.jacobian(points[:3])[1], model.jacobian(points[:3])[1])
    with torch.no_grad():
        again.weights.zero_()
        assert bool((model.weights > 0).any())
        # In the middle of an optimization weights may be negative.
        model.weights[0] = torch.tensor([-1.0, 0.0, 0.5])
    assert torch.equal(tr.GridLBS.from_state_dict(model.state_dict()).weights, model.weights)


def test_an_object_of_the_same_grid_takes_a_state_over():
    model, moved = random_model("dual_quaternion"), random_model()
    fresh = fresh_model(model)
    with torch.no_grad():
        moved.grid_origin.add_(0.5)
    for source in (model, moved):
        fresh.load_state_dict(source.state_dict())
        assert torch.equal(fresh(POINTS), source(POINTS))
        assert fresh.blend == source.blend
    assert not torch.equal(fresh(POINTS), random_model()(POINTS))


def test_a_state_within_a_larger_module():
    model = random_model()
    larger = torch.nn.ModuleDict({"scan": fresh_model(model), "head": torch.nn.Linear(2, 2)})
    other = torch.nn.ModuleDict({"scan": model, "head": torch.nn.Linear(2, 2)})
    larger.load_state_dict(other.state_dict())
    assert torch.equal(larger["scan"](POINTS), model(POINTS))
    with pytest.raises(InputError, match=r"lacks weights, .* has scan\.weights, .*without their prefix"):
        tr.GridLBS.from_state_dict(other.state_dict())


def test_states_from_before_grids_were_part_of_them_are_taken():
    model = random_model()
    former = {name: value for name, value in model.state_dict().items() if name not in GRID}
    assert len(former) == 4
    fresh = fresh_model(model)
    fresh.load_state_dict(former)
    assert torch.equal(fresh(POINTS), model(POINTS))
    with pytest.raises(InputError, match="lacks grid_cells, grid_shape, grid_origin, grid_axes, grid_spacing, blend"):
        tr.GridLBS.from_state_dict(former)


def test_states_of_other_grids_are_refused():
    model, other = random_model(), random_model(seed=5)
    before = model.weights.detach().clone()
    with pytest.raises(RuntimeError, match="grid_cells are of another grid; use GridLBS"):
        model.load_state_dict(other.state_dict())
    partial = model.state_dict()
    del partial["grid_spacing"], partial["grid_axes"]
    with pytest.raises(RuntimeError, match=r'Missing key\(s\) in state_dict: "grid_spacing", "grid_axes"'):
        model.load_state_dict(partial)
    assert torch.equal(model.weights, before)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda s: s.pop("twists"), InputError, "lacks twists; of a larger module"),
        (lambda s: s.update(bias=torch.ones(1)), InputError, "has bias"),
        (lambda s: s.update(weights=[1.0]), InputTypeError, "state must hold tensors, got list as weights"),
        (lambda s: s.update(weights=torch.tensor(1.0)), InputError, "weights must have shape"),
        (lambda s: s.update(weights=s["weights"][1:]), InputError, "weights must have shape"),
        (lambda s: s.update(weights=torch.nan * s["weights"]), InputError, "weights must be finite"),
        (lambda s: s.update(twists=s["twists"][0]), InputError, r"twists must have shape \(2, 3, 6\)"),
        (lambda s: s.update(middles=s["middles"][:2]), InputError, r"middles must have shape \(3, 3\)"),
        (lambda s: s["base_transforms"].mul_(2), InputError, "rigid motions"),
        (lambda s: s.update(grid_shape=torch.ones(2)), InputError, r"grid_shape must have shape \(3\)"),
        (lambda s: s.update(grid_shape=torch.ones(3).long()), InputError, "cells must lie in the box"),
        (lambda s: s.update(grid_cells=s["grid_cells"].double()), InputTypeError, "cells must hold integers"),
        (lambda s: s["grid_axes"].mul_(2), InputError, "axes must be a rotation"),
        (lambda s: s["grid_spacing"].mul_(-1), InputError, "spacing must be positive"),
        (lambda s: s.update(blend_number=torch.tensor(7)), InputError, "blend_number must be from 0 to 1, got 7"),
    ],
)
def test_foreign_states_are_refused_by_name(change, error, message):
    state = {name: value.detach().clone() for name, value in random_model().state_dict().items()}
    change(state)
    with pytest.raises(error, match=message):
        tr.GridLBS.from_state_dict(state)
    with pytest.raises(InputTypeError, match=r"state must be the state_dict\(\) of a GridLBS, got GridLBS"):
        tr.GridLBS.from_state_dict(random_model())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_graphics_card():
    model = random_model().to("cuda")
    numbers = {"grid_shape", "grid_spacing", "blend_number"}
    assert {name for name, value in model.state_dict().items() if not value.is_cuda} == numbers
    assert torch.equal(model.project_().weights.cpu(), random_model().project_().weights)
    assert tr.GridLBS.from_state_dict(model.state_dict()).weights.is_cuda
