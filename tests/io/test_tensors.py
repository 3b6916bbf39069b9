"""Named tensors with metadata on disk."""

import hashlib
import json
import math
import os

import pytest
import torch

import torchreg as tr
from tests.io.helpers import put
from tests.tables import each, refused, refusing
from torchreg.io.limits import FileLimits
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.storage import load_pose

METADATA = {"kind": "align", "steps": [1, 2.5, None, True], "nested": {"é": "ü"}, "sigma": math.inf, "low": -math.inf}


def example() -> dict[str, torch.Tensor]:
    base = torch.arange(12, dtype=torch.float64).reshape(3, 4)
    return {
        "zeta": base.T, "alpha": base[:, :2], "scalar": torch.tensor(2.5, requires_grad=True),
        "empty": torch.zeros(0, 3), "flags": torch.tensor([True, False]), "faces": torch.tensor([[0, 1, 2]]),
        "half": torch.tensor([math.nan, 1.0], dtype=torch.bfloat16),
    }  # fmt: skip


def stored(folder):
    save_tensors(folder / "r.safetensors", example(), METADATA)
    return folder / "r.safetensors"


@pytest.fixture
def saved(tmp_path):
    return stored(tmp_path)


def rewrite(path, change):
    record = json.loads(path.with_suffix(".json").read_text("utf-8"))
    change(record)
    path.with_suffix(".json").write_text(json.dumps(record), "utf-8")


def test_round_trip_is_exact_and_keeps_the_order(saved):
    tensors, metadata = load_tensors(str(saved))
    assert list(tensors) == list(example())
    for name, value in example().items():
        assert tensors[name].dtype == value.dtype
        torch.testing.assert_close(tensors[name], value.detach(), rtol=0, atol=0, equal_nan=True)
    assert not tensors["scalar"].requires_grad
    assert metadata == METADATA
    assert sorted(os.listdir(saved.parent)) == ["r.json", "r.safetensors"]
    text = saved.with_suffix(".json").read_text("utf-8")
    record = json.loads(text, parse_constant=pytest.fail)  # standard JSON has no NaN
    assert record["tensors"]["zeta"] == {"dtype": "float64", "shape": [4, 3]}
    assert ("ü" in text, text.count("\n") > 20) == (True, True)


def test_nothing_at_all_can_be_saved_and_saving_again_replaces_both(saved):
    for tensors, numbers in (({}, {"nan": math.nan, "tuple": (1, (2,))}), ({"one": torch.ones(1)}, {})):
        save_tensors(saved, tensors, numbers)
        found, metadata = load_tensors(saved)
        assert list(found) == list(tensors)
        assert repr(metadata) == repr({"nan": math.nan, "tuple": [1, [2]]} if numbers else {})


def test_every_flipped_byte_and_truncation_is_noticed(saved):
    content = saved.read_bytes()
    for place in range(0, len(content), 7):
        saved.write_bytes(content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :])
        with pytest.raises(tr.errors.FormatError, match="is damaged"):
            load_tensors(saved)
        saved.write_bytes(content[:place])
        with pytest.raises(tr.errors.FormatError, match=r"r\.safetensors: is damaged"):
            load_tensors(saved)


def test_damaged_json_is_refused(saved):
    beside = saved.with_suffix(".json")
    content = beside.read_bytes()
    for place in range(0, len(content) - 2, 11):
        beside.write_bytes(content[:place])
        with pytest.raises(tr.errors.FormatError, match=r"r\.json: cannot be read as JSON"):
            load_tensors(saved)
    for content in (b"[" * 100_000, b"\xff\xfe"):
        beside.write_bytes(content)
        refused((lambda: load_tensors(saved), "cannot be read as JSON"))


def reading(folder, change):
    path = stored(folder)
    rewrite(path, change)
    load_tensors(path)


test_json_that_does_not_belong_is_refused = refusing(reading)(
    (lambda r: r.update(format="other"), "does not describe tensors"),
    (lambda r: r.update(version=2), "has version 2, this release reads 1"),
    (lambda r: r.update(metadata=[]), "'metadata' must be of type dict"),
    (lambda r: r.pop("sha256"), "'sha256' must be of type str"),
    (lambda r: r["tensors"].pop("zeta"), "its tensors are not those that r.json lists"),
    (lambda r: r["tensors"]["zeta"].update(shape=[3, 4]), "its tensors are not those"),
    (lambda r: r["tensors"]["zeta"].update(dtype="float32"), "its tensors are not those"),
)


def test_right_checksum_of_a_damaged_file(saved):
    saved.write_bytes(b"\xff" * 40)
    rewrite(saved, lambda r: r.update(sha256=hashlib.sha256(b"\xff" * 40).hexdigest()))
    with pytest.raises(tr.errors.FormatError, match="cannot be read as safetensors"):
        load_tensors(saved)


def test_what_is_missing_too_large_or_called_otherwise(saved, tmp_path):
    refused(
        (lambda: load_tensors(tmp_path / "none.safetensors"), "none"),
        (lambda: save_tensors(tmp_path / "no" / "r.safetensors", {}, {}), "does not exist; create it first"),
        error=FileNotFoundError,
    )
    refused(
        (lambda: save_tensors(saved.with_suffix(".pt"), {}, {}), r"must end in \.safetensors"),
        error=tr.errors.InputError,
    )
    refused(
        (lambda: load_tensors(saved, limits=FileLimits(max_bytes=100)), "the limit is 100"),
        (lambda: load_tensors("https://host/r.safetensors"), "is an address"),
    )
    saved.with_suffix(".json").unlink()
    refused((lambda: load_tensors(saved), r"the file r\.json must lie beside it"))


test_what_cannot_be_saved = refusing(lambda folder, *given: save_tensors(folder / "r.safetensors", *given), leaves=0)(
    ({"a": [1.0]}, {}, tr.errors.InputTypeError, r"tensors\['a'\] must be a tensor under a str, got list"),
    ({1: torch.ones(1)}, {}, tr.errors.InputTypeError, r"tensors\[1\] must be"),
    ({"a": torch.eye(2).to_sparse()}, {}, tr.errors.InputTypeError, "must be dense, got layout torch.sparse_coo"),
    ({"a": torch.ones(2, dtype=torch.complex128)}, {}, tr.errors.InputTypeError, "tensors cannot be stored"),
    (
        {},
        {"h": [{"loss": torch.ones(1)}]},
        tr.errors.InputTypeError,
        r"metadata\.h\[0\]\.loss must be a dict, .* got Tensor",
    ),
    ({}, {3: 1}, tr.errors.InputTypeError, "metadata must have keys of type str, got 3"),
    ({}, {"$float": 1}, tr.errors.InputError, "reserved"),
)


@each(b"[" + b"9" * 4400 + b"]", b"[1e999]", b"[" * 5000, b'{"x": 1' + b"0" * 400 + b"}")
def test_poses_in_json_that_are_refused(tmp_path, content):
    with pytest.raises(tr.errors.TorchregError):
        load_pose(put(tmp_path, "pose.json", content), tr.Hand())


@pytest.mark.parametrize(("poses", "costs"), [((2, 27), (3,)), ((21, 3), (2,)), ((), (2,))])
def test_results_whose_shapes_do_not_fit_are_refused(tmp_path, poses, costs):
    tr.PoseStarts(torch.zeros(poses), torch.zeros(costs), torch.ones(())).save(tmp_path / "a.safetensors")
    with pytest.raises(tr.errors.FormatError, match=r"poses|costs"):
        tr.load(tmp_path / "a.safetensors")
