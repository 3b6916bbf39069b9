"""Files that once raised what is not an error of torchreg, or were accepted though they hold nothing sensible."""

import io
import json
import struct

import numpy as np
import pytest
import torch

import torchreg as tr
from torchreg.errors import FormatError, TorchregError
from torchreg.io.calibration import load_depth_camera
from torchreg.io.cameras.opencv_yaml import load_opencv
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.images import load_depth, load_mask
from torchreg.io.limits import DEFAULT_LIMITS
from torchreg.io.urdf import load_urdf
from torchreg.storage import load_pose


def npy(shape="(2, 3)", descr="'<f4'", order="False", body=bytes(24), more=""):
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {more}}}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + body


@pytest.mark.parametrize(
    "content",
    [
        npy()[:60],
        npy()[:9],
        npy(shape="(-2, -3)"),
        npy(shape="(True, 6)"),
        npy(shape="(2, 3.0)"),
        npy(shape="[2, 3]"),
        npy(descr="[('x', '<f4')]"),
        npy(descr="('<f4', (2,))"),
        npy(descr="'O'"),
        npy(descr="'nonsense'"),
        npy(order="None"),
        npy(more="'x': 1"),
        npy(shape="(2, 3"),
        npy(shape="(2, 3)" + "+1" * 40),
    ],
)
def test_headers_of_arrays_are_no_python(tmp_path, content):
    for name, load in (("a.npy", load_depth), ("a.npy", load_mask)):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(FormatError, match=r"a\.npy"):
            load(path)


@pytest.mark.parametrize("values", [np.full((2, 3), "x"), np.zeros((2, 3), "M8[s]"), np.zeros((2, 3), complex)])
def test_masks_are_numbers_or_truth_values(tmp_path, values):
    stream = io.BytesIO()
    np.save(stream, values)
    (tmp_path / "mask.npy").write_bytes(stream.getvalue())
    with pytest.raises(FormatError, match=r"masks? .*are|must hold"):
        load_mask(tmp_path / "mask.npy")


@pytest.mark.parametrize("order", "CF")
def test_arrays_keep_their_order(tmp_path, order):
    values = np.asarray(np.arange(1, 7, dtype=np.float32).reshape(2, 3), order=order)
    np.save(tmp_path / "depth.npy", values)
    np.testing.assert_array_equal(load_depth(tmp_path / "depth.npy", 1.0).numpy(), values)


CAMERA = {"width": 4, "height": 4, "fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0}


@pytest.mark.parametrize("name", [*CAMERA, "depth_scale"])
@pytest.mark.parametrize("value", ["1" + "0" * 400, "[]", "[1, 2]", "9" * 4400, '"1"', "null", "{}", "1e999"])
def test_numbers_of_cameras_are_numbers(tmp_path, name, value):
    text = json.dumps(CAMERA | {"depth_scale": 1.0} | {name: "HERE"}).replace('"HERE"', value)
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(TorchregError):
        load_depth_camera(tmp_path / "camera.json")


MATRIX = "M: !!opencv-matrix\n  rows: 1\n  cols: 1\n  dt: d\n  data: [ 1 ]"


@pytest.mark.parametrize(
    "body",
    ["", "no entries", "camera_matrix: !!opencv-matrix\nx", MATRIX.replace("rows: 1", "rows: \u0663"),
     MATRIX.replace("rows: 1", "rows: " + "9" * 5000), "image_width: \u00b2\nimage_height: 3",
     "image_width: " + "9" * 5000],
)  # fmt: skip
def test_yaml_without_what_is_needed(tmp_path, body):
    (tmp_path / "a.yml").write_text("%YAML:1.0\n---\n" + body, encoding="utf-8")
    with pytest.raises(FormatError, match=r"a\.yml"):
        load_opencv(tmp_path / "a.yml")


@pytest.mark.parametrize("digits", ["\u00b2", "9" * 5000])
def test_sizes_of_colmap_are_plain_digits(tmp_path, digits):
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {digits} 4 1 1 1 1\n", encoding="utf-8")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a\n\n")
    with pytest.raises(FormatError, match="must be CAMERA_ID"):
        tr.load_cameras(tmp_path)


@pytest.mark.parametrize("stride", [10**300, 2**62, -1])
def test_strides_and_addresses_of_buffers(tmp_path, stride):
    view = {"buffer": 0, "byteLength": 12, "byteStride": stride}
    accessor = {"bufferView": 0, "count": 1, "type": "VEC3", "componentType": 5126}
    entries = {"buffers": [{"byteLength": 12, "uri": "\ud800.bin"}], "bufferViews": [view], "accessors": [accessor]}
    document = GltfDocument(json.dumps(entries).encode(), tmp_path / "a.gltf", DEFAULT_LIMITS)
    with pytest.raises(FormatError, match="must lie in the file's folder"):
        document.accessor(0)
    entries["buffers"][0]["uri"] = "data:application/octet-stream;base64,AAAAAAAAAAAAAAAA"
    document = GltfDocument(json.dumps(entries).encode(), tmp_path / "a.gltf", DEFAULT_LIMITS)
    with pytest.raises(FormatError, match=r"byteStride|reaches beyond"):
        document.accessor(0)


@pytest.mark.parametrize(
    "content", [b"[" + b"9" * 4400 + b"]", b"[1e999]", b"[" * 5000, b'{"x": 1' + b"0" * 400 + b"}"]
)
def test_poses_in_json(tmp_path, content):
    (tmp_path / "pose.json").write_bytes(content)
    with pytest.raises(TorchregError):
        load_pose(tmp_path / "pose.json", tr.Hand())


def test_chains_of_mimic_joints_take_time_in_proportion(tmp_path):
    count = 1500
    links = "".join(f'<link name="l{k}"/>' for k in range(count + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l0"/><child link="l{k + 1}"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1" upper="1"/>'
        + (f'<mimic joint="j{k + 1}" multiplier="-1" offset="0.5"/>' if k + 1 < count else "")
        + "</joint>"
        for k in range(count)
    )
    (tmp_path / "r.urdf").write_text(f"<robot name='r'>{links}{joints}</robot>")
    tree = load_urdf(tmp_path / "r.urdf").tree
    by_name = {joint.name: joint for joint in tree.joints}
    last = list(by_name).index(f"j{count - 1}")
    assert by_name["j0"].mimic == (last, -1.0, 0.5)
    assert by_name["j1"].mimic == (last, 1.0, 0.0)


@pytest.mark.parametrize(
    ("poses", "costs"),
    [((2, 27), (3,)), ((21, 3), (2,)), ((), (2,))],
)
def test_results_whose_shapes_do_not_fit_are_refused(tmp_path, poses, costs):
    tr.PoseStarts(torch.zeros(poses), torch.zeros(costs), torch.ones(())).save(tmp_path / "a.safetensors")
    with pytest.raises(FormatError, match=r"poses|costs"):
        tr.load(tmp_path / "a.safetensors")
