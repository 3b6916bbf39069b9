"""The energy of scan registration: each term by its definition, what the steps minimize, gradients."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import rand, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.sparse_grid import SparseGrid

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError
ALL = {"distance": 2.0, "joint": 0.7, "smoothness": 0.4, "norm": 0.9, "discontinuity": 0.3}


def scene(bones, resolution=6, count=60, batch=()):
    """A limb with random weights and motions, and matches of its points."""
    points, _ = bones.limb(count)
    grid = SparseGrid.from_points(points, resolution, frame="world")
    model = tr.GridLBS(grid, randn(grid.num_corners, 3, seed=1).abs(), se3_exp(0.3 * randn(*batch, 3, 6, seed=2)))
    targets = points + 0.1 * randn(*batch, count, 3, seed=3)
    normals = torch.nn.functional.normalize(randn(*batch, count, 3, seed=4), dim=-1)
    return model, points, targets, normals, randn(*batch, count, seed=5).clamp_min(0)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_terms_are_those_of_their_definitions(bones, share):
    model, points, targets, normals, kept = scene(bones)
    labels = torch.nn.functional.one_hot(model.weights.argmax(-1), 3).double()
    energy = tr.RegistrationEnergy(model, label_weights=labels, point_to_point=share, **ALL)
    with torch.no_grad():
        terms = energy.terms(points, targets, normals, kept)
        total = energy(points, targets, normals, kept)
        off = model(points) - targets
    grid, raw = model.grid, model.weights.detach()
    squares = (1 - share) * (off * normals).sum(-1) ** 2 + share * off.square().sum(-1)
    expected = {
        "distance": grid.num_cells * float(kept @ squares / kept.sum()) / grid.spacing**2,
        "joint": float(terms["joint"]) / ALL["joint"],  # see test_joint_energy
        "smoothness": sum(float((raw[c] - raw[d]).square().sum()) for c, d in grid.edges().tolist()),
        "norm": float((1 - raw.sum(1)).square().sum()),
        "discontinuity": float((raw - labels).square().sum()),
    }
    assert list(terms) == list(expected)
    for name, value in expected.items():
        assert float(terms[name]) == pytest.approx(ALL[name] * value, rel=1e-9), name
    assert float(total) == pytest.approx(sum(float(term) for term in terms.values()))
    # Dropped matches may hold anything, and points alone need no normals.
    if share == 1.0:
        targets[kept == 0] = torch.nan
        torch.testing.assert_close(energy(points, targets, match_weights=kept).detach(), total)


def test_equation_2_has_no_labels_and_its_weights_are_the_papers(bones):
    model, *matches = scene(bones)
    terms = tr.RegistrationEnergy(model).terms(*matches)
    assert float(terms["discontinuity"]) == 0
    alone = {name: tr.RegistrationEnergy(model, **{n: float(n == name) for n in ALL})(*matches) for name in ALL}
    for name, weight in (("distance", 1.0), ("joint", 0.05), ("smoothness", 0.5), ("norm", 1.0)):
        torch.testing.assert_close(terms[name], weight * alone[name])


def test_gradients_in_motions_and_weights(bones):
    model, points, targets, normals, kept = scene(bones, resolution=2, count=8)
    with torch.no_grad():
        # A bone without weight in some corners has the right gradient there too.
        model.weights[::3, 0] = 0.0
        model.twists.add_(0.1 * randn(3, 6, seed=9))
    energy = tr.RegistrationEnergy(model, label_weights=model.corner_weights().detach(), **ALL)

    def of(transforms, weights, twists, targets):
        values, given = {"model.weights": weights, "model.twists": twists}, (points, targets, normals, kept)
        own = torch.func.functional_call(energy, values, given)
        return own + torch.func.functional_call(energy, values, (*given, transforms))

    inputs = (model.transforms, model.weights, model.twists, targets)
    inputs = tuple(value.detach().clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(of, inputs, fast_mode=True)


def test_poses_come_in_batches(bones):
    model, points, targets, normals, kept = scene(bones, batch=(2,))
    energy = tr.RegistrationEnergy(model, **ALL)
    found, terms = energy(points, targets, normals, kept), energy.terms(points, targets, normals, kept)
    assert found.shape == terms["joint"].shape == (2,)
    assert terms["smoothness"].shape == ()
    for k in range(2):
        one = energy(points, targets[k], normals[k], kept[k], model.transforms[k])
        torch.testing.assert_close(found[k], one)


def test_units_and_common_motions_change_nothing(bones):
    model, points, targets, normals, kept = scene(bones)
    expected = tr.RegistrationEnergy(model, **ALL)(points, targets, normals, kept)
    motion = se3_exp(randn(6, seed=8))
    turned = transform_points(motion, targets), normals @ motion[:3, :3].mT, kept, motion @ model.transforms
    torch.testing.assert_close(tr.RegistrationEnergy(model, **ALL)(points, *turned), expected)
    wide = model.rescaled(100.0, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(tr.RegistrationEnergy(wide, **ALL)(100 * points, 100 * targets, normals, kept), expected)


def test_it_is_a_module(bones):
    model, *matches = scene(bones)
    energy = tr.RegistrationEnergy(model, **ALL)
    assert [name for name, _ in energy.named_parameters()] == ["model.weights", "model.twists"]
    other = tr.RegistrationEnergy(scene(bones)[0], label_weights=torch.zeros_like(model.weights), **ALL)
    other.load_state_dict(energy.state_dict())
    assert torch.equal(other(*matches), energy(*matches))
    single = other.float()(*(value.float() for value in matches))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), energy(*matches), rtol=1e-4, atol=0)


def test_the_labels_stay_while_the_weights_are_learnt(bones):
    model, *matches = scene(bones)
    model.project_()
    energies = [tr.RegistrationEnergy(model, label_weights=given, **ALL) for given in (None, model.weights)]
    assert [energy.terms(*matches)["discontinuity"].item() for energy in energies] == pytest.approx([0, 0], abs=1e-20)
    with torch.no_grad():
        model.weights.add_(0.5)
    for energy in energies:
        assert energy.terms(*matches)["discontinuity"].item() == pytest.approx(0.3 * 0.25 * model.weights.numel())


LIMB = rand(60, 3)
MODEL = tr.GridLBS(SparseGrid.from_points(LIMB, 3), torch.ones(SparseGrid.from_points(LIMB, 3).num_corners, 3))


@pytest.mark.parametrize(
    ("change", "given", "error", "words"),
    [
        ({"stiffness": 1.0}, (), InputError, "no energy term .stiffness.; known: distance, joint, smoothness, norm"),
        ({"joint": -1.0}, (), InputError, "joint must be zero or positive"),
        ({"norm": "1"}, (), InputTypeError, "norm must be a number"),
        ({"point_to_point": 2.0}, (), InputError, "point_to_point must be from 0 to 1"),
        ({"label_weights": torch.ones(2, 3)}, (), InputError, "label_weights must have shape"),
        ({"label_weights": torch.nan * MODEL.weights}, (), InputError, "label_weights must be finite"),
        ({"model": torch.nn.Linear(2, 2)}, (), InputTypeError, "model must be a GridLBS, got Linear"),
        ({}, (LIMB, LIMB), InputError, "normals are needed"),
        ({"point_to_point": 1 - 1e-9}, (LIMB, LIMB), InputError, "normals are needed for point to plane"),
        ({}, (LIMB[:, :2], LIMB, LIMB), InputError, "points must have shape"),
        ({}, (LIMB, LIMB[1:], LIMB), InputError, "targets must have shape"),
        ({}, (LIMB, LIMB, LIMB[1:]), InputError, "normals must have shape"),
        ({}, (LIMB, LIMB, LIMB, LIMB[1:, 0]), InputError, "match_weights must have shape"),
        ({}, (LIMB, LIMB, LIMB, LIMB[:, 0], torch.eye(4)), InputError, "transforms must have shape"),
        ({}, (LIMB.float(), LIMB, LIMB), InputTypeError, "points is torch.float32 on cpu but model is"),
        ({}, (LIMB, LIMB.float(), LIMB), InputTypeError, "targets is"),
    ],
)
def test_bad_input_is_named(change, given, error, words):
    with pytest.raises(error, match=words):
        tr.RegistrationEnergy(**{"model": MODEL, **change})(*given)
