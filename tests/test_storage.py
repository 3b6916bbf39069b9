"""Results on disk: every field comes back as it was, damaged files are refused, poses are read from several formats."""

import json
import subprocess
import sys
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

import torchreg as tr
from torchreg import storage
from torchreg.alignment.results import AlignRecord, AlignResult, Calibration
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.result import Result, Status, formerly
from torchreg.shapes.primitives import Primitive
from torchreg.storage import load_pose
from torchreg.tracking.results import DemoResult, TrackResult

FormatError, InputError, InputTypeError = tr.errors.FormatError, tr.errors.InputError, tr.errors.InputTypeError


def record(step, batch=1, dtype=torch.float32):
    generator = torch.Generator().manual_seed(step)
    values = torch.randn(3 + 9, batch, generator=generator).to(dtype)
    return AlignRecord("em", step, 5, values[0], values[1], values[3:].mT.contiguous(), values[2])


def result(batch=(), dtype=torch.float32, history=()):
    generator = torch.Generator().manual_seed(1)

    def draw(*size):
        return torch.randn((*batch, *size), generator=generator).to(dtype)

    distances = draw(6)
    distances[..., -1] = torch.nan
    statuses = (Status.CONVERGED, Status.NO_DATA, Status.FEW_INLIERS)
    return AlignResult(
        pose=draw(9), registered=draw(5, 3), keypoints=draw(4, 3), distances=distances,
        inliers=distances.abs() < 0.5, posterior=draw(6), sigma=draw(), cost=draw(),
        status=tuple(statuses[k % 3] for k in range(batch[0])) if batch else Status.MAX_STEPS, history=history,
    )  # fmt: skip


def same(a, b):
    """Return whether two values are alike to the last bit and type; an independent walk over what a result holds."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a.nan_to_num(777.0), b.nan_to_num(777.0))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, item.name), getattr(b, item.name)) for item in fields(a))
    if isinstance(a, torch.nn.Module):
        return a.state_dict().keys() == b.state_dict().keys() and all(
            map(same, *[tuple(x.state_dict().values()) for x in (a, b)])
        )
    return a is b or a == b


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_results_come_back_as_they_were(tmp_path, batch, dtype):
    history = tuple(record(step, batch=3, dtype=dtype) for step in range(4))
    saved = result(batch, dtype, history)
    saved.save(tmp_path / "r.safetensors")
    loaded = tr.load(tmp_path / "r.safetensors")
    assert same(saved, loaded)
    assert not same(replace(saved, cost=saved.cost + 1), loaded)


def test_records_of_different_batches_come_back_in_order(tmp_path):
    """A search refines only some problems of a batch, so the steps of a history differ in size."""
    saved = result((3,), history=(record(0, batch=3), record(1, batch=3), record(2, batch=1), record(3, batch=2)))
    saved.save(tmp_path / "r.safetensors")
    assert same(saved, tr.load(tmp_path / "r.safetensors"))


def test_what_align_returns_can_be_saved(tmp_path):
    hand = tr.Hand()
    data = hand.keypoints(hand.rest_pose()).detach()
    with_gradients = tr.align(hand, data, config=tr.AlignConfig(search="never", num_model_points=60))
    with_gradients.save(tmp_path / "r.safetensors")
    loaded = tr.load(tmp_path / "r.safetensors")
    assert same(replace(with_gradients, keypoints=with_gradients.keypoints.detach()), loaded)
    assert len(loaded.history) > 3


def track(frames=2):
    return TrackResult(
        poses=torch.full((frames, 27), torch.nan), std=torch.zeros(frames, 27), keypoints=torch.ones(frames, 21, 3),
        inlier_ratios=torch.ones(frames, dtype=torch.float64), residuals=torch.zeros(frames, dtype=torch.float64),
        times=torch.arange(frames, dtype=torch.float64), seconds=torch.ones(frames, dtype=torch.float64),
        statuses=(Status.CONVERGED, Status.LOST) * (frames // 2), acquired=("found", "lost") * (frames // 2),
    )  # fmt: skip


def demonstration():
    return DemoResult(
        track=track(), truths=torch.ones(2, 27), clouds=(torch.ones(4, 3), torch.zeros(5, 3)),
        inliers=(torch.tensor([True, False, True, True]), torch.ones(5, dtype=torch.bool)),
        tip_errors=torch.zeros(2, 5), tips_seen=torch.ones(2, 5, dtype=torch.bool), seed=7,
    )  # fmt: skip


def test_demo_results_come_back_with_their_track(tmp_path):
    saved = demonstration()
    saved.save(tmp_path / "poses.safetensors")
    assert same(saved, tr.load(tmp_path / "poses.safetensors"))


def calibration(shape):
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in shape.parameters():
            parameter.mul_(1 + 0.1 * torch.rand(parameter.shape, generator=generator).to(parameter))
        shape.log_length_scales.add_(0.1)
    scales = shape.log_length_scales.detach().clone(), shape.log_radius_scales.detach().clone()
    poses = torch.randn(3, shape.num_dofs, generator=generator).to(shape.rest)
    return Calibration(shape, poses, *scales, cost=torch.tensor(2.5), status=Status.CONVERGED)


def make_arm():
    eye = torch.eye(4, dtype=torch.float64)
    joints = Joint("base", -1, eye), Joint("arm", 0, eye, "revolute", (0.0, 1.0, 0.0), -1.0, 2.0)
    solids = Primitive("ellipsoid", (0.1, 0.1, 0.1), eye), Primitive("capsule", (0.3, 0.05), eye)
    return tr.ArticulatedShape(KinematicTree(joints), ["base", "arm"], solids, dtype=torch.float64)


@pytest.mark.parametrize("make", [tr.Hand, make_arm])
def test_calibrations_come_back_with_their_shape(tmp_path, make):
    saved = calibration(make())
    saved.save(tmp_path / "c.safetensors")
    loaded = tr.load(tmp_path / "c.safetensors")
    assert type(loaded) is Calibration
    assert type(loaded.shape) is type(saved.shape)
    assert all(same(getattr(saved, item.name), getattr(loaded, item.name)) for item in fields(saved)[1:])
    points = torch.rand(3, 40, 3, generator=torch.Generator().manual_seed(5)).to(saved.poses)
    assert torch.equal(loaded.shape.distance(points, loaded.poses), saved.shape.distance(points, saved.poses))
    assert torch.equal(loaded.shape.keypoints(loaded.poses), saved.shape.keypoints(saved.poses))
    assert loaded.shape.dof_names == saved.shape.dof_names
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "c.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s["spec"]["fields"].update(nu=-1.0), "nu must be positive"),
        (lambda s: s["spec"]["fields"].update(part_frames=["base", "leg"]), "the tree does not have: leg"),
        (lambda s: s["spec"]["fields"]["tree"]["fields"]["joints"]["columns"].update(parent=[-1, 1]), "arm"),
        (lambda s: s["spec"]["fields"]["primitives"]["columns"].update(kind=["capsule", "box"]), "primitive 0 .*needs"),
        (lambda s: s.update(parameters=s["parameters"][:-1]), "needs parameters of shapes"),
        (lambda s: s.update(spec=None), r"fields\.shape\.spec must not be of type NoneType"),
        (lambda s: s.update(learnable=[1] * 5), "must not be of type tuple"),
    ],
)
def test_shapes_that_cannot_be_built_are_refused(tmp_path, change, message):
    calibration(make_arm()).save(tmp_path / "c.safetensors")
    edit(tmp_path / "c.json", lambda metadata: change(metadata["fields"]["shape"]["fields"]))
    with pytest.raises(FormatError, match=rf"c\.safetensors: is not a complete Calibration .*{message}"):
        tr.load(tmp_path / "c.safetensors")


def leaves(value, path=()):
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [leaf for key, inner in items for leaf in leaves(inner, (*path, key))]


def test_any_damaged_entry_of_a_shape_is_refused_or_read(tmp_path):
    """No damage of the JSON file gets past `load` as anything but a FormatError."""
    calibration(make_arm()).save(tmp_path / "c.safetensors")
    whole = (tmp_path / "c.json").read_text(encoding="utf-8")
    refused = 0
    for place in leaves(json.loads(whole)["metadata"]["fields"]["shape"]):
        for value in (None, -1, 3.5, "x", [], {}, {"tensor": "poses"}, {"stack": "poses"}):
            description = json.loads(whole)
            owner = description["metadata"]["fields"]["shape"]
            for key in place[:-1]:
                owner = owner[key]
            owner[place[-1]] = value
            (tmp_path / "c.json").write_text(json.dumps(description), encoding="utf-8")
            try:
                tr.load(tmp_path / "c.safetensors")
            except FormatError:
                refused += 1
    assert refused > 300


def test_unknown_results_are_neither_saved_nor_loaded(tmp_path):
    @dataclass(frozen=True)
    class Other(Result):
        value: torch.Tensor

    with pytest.raises(InputTypeError, match=r"result must be of a public kind of torchreg, got Other"):
        Other(torch.zeros(1)).save(tmp_path / "r.safetensors")
    assert list(tmp_path.iterdir()) == []
    result().save(tmp_path / "r.safetensors")
    edit(tmp_path / "r.json", lambda metadata: metadata.update(kind="Other"))
    with pytest.raises(FormatError, match=r"r\.safetensors: holds a result of kind 'Other', which this"):
        tr.load(tmp_path / "r.safetensors")
    for kind in (["AlignResult"], "align", "AlignConfig", "__doc__", "_HOMES"):
        edit(tmp_path / "r.json", lambda metadata, kind=kind: metadata.update(kind=kind))
        with pytest.raises(FormatError, match="of kind"):
            tr.load(tmp_path / "r.safetensors")


def test_fields_that_cannot_be_stored_are_named(tmp_path):
    with pytest.raises(
        InputTypeError, match=r"sigma cannot be stored: list is not a tensor, record, tuple, dict or number"
    ):
        replace(result(), sigma=[1.0]).save(tmp_path / "r.safetensors")
    with pytest.raises(InputTypeError, match=r"history\.1\.cost cannot be stored: set"):
        replace(result(), history=((), replace(record(0), cost={1}))).save(tmp_path / "r.safetensors")


def edit(path, change):
    description = json.loads(path.read_text(encoding="utf-8"))
    change(description["metadata"])
    path.write_text(json.dumps(description), encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("pose"), "fields lacks or does not know pose"),
        (lambda f: f.update(color=1), "lacks or does not know color"),
        (lambda f: f.update(pose=3), r"fields\.pose must not be of type int"),
        (lambda f: f.update(pose={"tensor": "poses"}), "names the tensor 'poses', which is not there"),
        (lambda f: f.update(pose={"tensor": ["pose"]}), "which is not there"),
        (lambda f: f.update(pose={"array": "pose"}), r"fields\.pose holds entries array"),
        (lambda f: f.update(status={"enum": "Status", "value": "fine"}), "unknown Status 'fine'"),
        (lambda f: f.update(status={"enum": "Status", "value": []}), r"unknown Status \[\]"),
        (lambda f: f.update(status={"enum": "Path", "value": "/"}), "of the unknown kind 'Path'"),
        (lambda f: f.update(status=["converged"]), r"fields\.status must not be of type tuple"),
        (lambda f: f.update(history={"table": "AlignResult", "rows": 0, "columns": {}}), "unknown kind 'AlignResult'"),
        (lambda f: f["history"].update(columns=[]), "has no columns"),
        (lambda f: f["history"].update(rows=10**15), "does not have 1000000000000000 rows"),
        (lambda f: f["history"]["columns"].update(sigma={"stack": "sigma"}), "does not have 2 rows"),
        (lambda f: f["history"]["columns"].update(step=1), r"history\.step must be a list"),
        (lambda f: f["history"]["columns"].update(step=["a", "b"]), r"history\[0\]\.step must not be of type str"),
        (lambda f: f.update(history=[{"record": "AlignRecord", "fields": []}]), r"history\[0\] must be a dict"),
    ],
)
def test_wrong_content_is_refused_with_its_place(tmp_path, change, message):
    result(history=(record(0), record(1))).save(tmp_path / "r.safetensors")
    edit(tmp_path / "r.json", lambda metadata: change(metadata["fields"]))
    with pytest.raises(FormatError, match=rf"r\.safetensors: is not a complete AlignResult .*{message}"):
        tr.load(tmp_path / "r.safetensors")


def test_other_tensors_are_no_result(tmp_path):
    from torchreg.io.tensors import save_tensors

    save_tensors(tmp_path / "t.safetensors", {"pose": torch.zeros(3)}, {})
    with pytest.raises(FormatError, match="of kind None"):
        tr.load(tmp_path / "t.safetensors")
    with pytest.raises(FileNotFoundError):
        tr.load(tmp_path / "none.safetensors")


@pytest.fixture(scope="module")
def hand():
    return tr.Hand()


def test_poses_are_read_from_every_format(tmp_path, hand):
    pose = torch.linspace(-1, 1, hand.num_dofs)
    named = dict(zip(hand.dof_names, pose.tolist(), strict=True))
    (tmp_path / "list.json").write_text(json.dumps(pose.tolist()), encoding="utf-8")
    (tmp_path / "named.json").write_text(json.dumps(named), encoding="utf-8")
    np.savez(tmp_path / "named.npz", pose=pose.numpy(), other=np.zeros(2))
    np.savez(tmp_path / "single.npz", pose.numpy())
    replace(result(), pose=pose).save(tmp_path / "result.safetensors")
    for name in ("list.json", "named.json", "named.npz", "single.npz", "result.safetensors", "result.json"):
        assert torch.equal(load_pose(tmp_path / name, hand), pose), name


def test_joints_that_are_not_named_stay_at_rest(tmp_path, hand):
    (tmp_path / "p.json").write_text('{"base_z": 0.5, "index_pip_flexion": 1}', encoding="utf-8")
    pose = load_pose(tmp_path / "p.json", hand)
    assert pose[hand.dof_names.index("base_z")] == 0.5
    assert pose[hand.dof_names.index("index_pip_flexion")] == 1
    assert pose.count_nonzero() == 2
    assert pose.dtype == hand.rest.dtype


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("p.json", b'{"index": 1}', InputError, r"no degree of freedom 'index'; known: base_x, "),
        ("p.json", b"[0, 1]", InputError, r"the pose in .*p\.json must have shape \(27\), got \(2,\)"),
        ("p.json", b'{"base_x": NaN}', InputError, "must be finite"),
        ("p.json", b'"flat"', FormatError, "a pose is a list of 27 numbers, or numbers by name"),
        ("p.json", b'{"base_x": true}', FormatError, "a pose is a list"),
        ("p.json", b"{", FormatError, "cannot be read as JSON"),
        ("p.npz", b"PK", FormatError, r"p\.npz: is not a readable zip"),
        (
            "p.csv",
            b"0,1",
            FormatError,
            "must hold a line of names, such as base_x, base_y, base_z, base_rx, and a line",
        ),
        ("p.xml", b"0,1", FormatError, r"has the ending '\.xml'; a pose is read from \.safetensors, \.json, "),
    ],
)
def test_files_without_a_pose_are_refused(tmp_path, hand, name, content, error, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(error, match=message):
        load_pose(tmp_path / name, hand)


def test_the_last_known_pose_of_a_track_is_read(tmp_path, hand):
    poses = torch.arange(3.0).unsqueeze(-1).repeat(1, hand.num_dofs)
    poses[2], done = torch.nan, (Status.CONVERGED,) * 3
    replace(track(3), poses=poses, std=poses, statuses=done, acquired=("tracked",) * 3).save(tmp_path / "t.safetensors")
    assert torch.equal(load_pose(tmp_path / "t.json", hand), poses[1])
    replace(track(3), poses=poses * torch.nan, std=poses, statuses=done, acquired=("tracked",) * 3).save(
        tmp_path / "n.safetensors"
    )
    with pytest.raises(FormatError, match="in which the shape was never found"):
        load_pose(tmp_path / "n.safetensors", hand)


def test_energies_by_name_come_back_and_old_files_have_none(tmp_path):
    """Also where records differ in the names they hold."""
    path = Path(__file__).parent / "saved" / "0.1.0" / "ScanRegistration.safetensors"
    old = tr.load(path)
    assert len(old.history) > 0
    assert all(record.energies == {} for record in old.history)
    energies = {"distance": 0.1, "joint": 1 / 3, "a new term": 2e-300}
    saved = replace(old, history=(replace(old.history[0], energies=energies), *old.history))
    saved.save(tmp_path / "m.safetensors")
    assert tr.load(tmp_path / "m.safetensors").history == saved.history
    for wrong, message in (
        ({"dict": 3}, "must be a dict"),
        ({"dict": {"joint": "low"}}, "must not be of type dict"),
        ([1.0], "must not be of type tuple"),
        ({"dict": {"joint": {"tensor": "nothing"}}}, "names the tensor 'nothing', which is not there"),
    ):
        saved.save(tmp_path / "m.safetensors")
        edit(tmp_path / "m.json", lambda m, w=wrong: m["fields"]["history"]["columns"]["energies"].__setitem__(0, w))
        with pytest.raises(FormatError, match=message):
            tr.load(tmp_path / "m.safetensors")


SAVED = sorted((Path(__file__).parent / "saved").glob("*/*.safetensors"))


@pytest.mark.parametrize("path", SAVED, ids=lambda path: f"{path.parent.name} {path.stem}")
def test_what_earlier_releases_saved_is_read(path):
    """Every tensor that is a field is as in the file."""
    if path.stem == "PosePrior":
        assert tr.PosePrior.load(path).num_components == 7
        return
    stored, loaded = safetensors.torch.load_file(path), tr.load(path)
    assert type(loaded).__name__ == path.stem
    direct = [item.name for item in fields(loaded) if item.name in stored]
    assert all(same(stored[name], getattr(loaded, name)) for name in direct)
    assert len(direct) >= 3 or path.stem == "DemoResult"


def test_a_renamed_field_is_read_under_its_former_name(tmp_path, monkeypatch):
    @dataclass(frozen=True)
    class AlignResult(Result):
        width: torch.Tensor = field(metadata=formerly("sigma"))
        cost: float = 0.0

    @dataclass(frozen=True)
    class Former(Result):
        sigma: torch.Tensor
        cost: float

    for kind in (Former, AlignResult):
        monkeypatch.setattr(storage, "public", lambda name, kind=kind: kind)
        if kind is Former:
            Former(torch.ones(2), 3.0).save(tmp_path / "r.safetensors")
    assert same(tr.load(tmp_path / "r.safetensors"), AlignResult(torch.ones(2), 3.0))


def test_results_are_read_in_a_process_that_imported_nothing_yet():
    paths = [str(path) for path in SAVED if path.stem != "PosePrior"]
    code = f"import torchreg as tr; print(*(type(tr.load(path)).__name__ for path in {paths}))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.split() == [path.stem for path in SAVED if path.stem != "PosePrior"]
