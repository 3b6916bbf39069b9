"""glTF documents: entries, accessors of every kind, buffers, nodes; what is damaged is said, not read."""

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest

import torchreg as tr
from tests.gltf_player import KINDS, TYPES
from tests.tables import refused, refusing
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.limits import FileLimits

FormatError, ModelError = tr.errors.FormatError, tr.errors.ModelError


def opened(content, path=Path("a.gltf"), limits=None):
    return GltfDocument(
        content if isinstance(content, bytes) else json.dumps(content).encode(), path, limits or FileLimits()
    )


def data_uri(binary):
    return "data:application/octet-stream;base64," + base64.b64encode(binary).decode()


def holding(values, *, stride=0, offset=0, **entries):
    """Return the JSON of a document with one accessor for the rows of ``values``, which lie in the file itself."""
    binary = b"\xdd" * offset + b"".join(row.tobytes().ljust(stride, b"\xee") for row in values)
    view = {"buffer": 0, "byteLength": len(binary)} | ({"byteStride": stride} if stride else {})
    accessor = {
        "bufferView": 0, "byteOffset": offset, "componentType": KINDS[values.dtype.str[1:]],
        "count": len(values), "type": TYPES[values.shape[1]],
    }  # fmt: skip
    buffers = [{"byteLength": len(binary), "uri": data_uri(binary)}]
    return {"accessors": [accessor | entries], "bufferViews": [view], "buffers": buffers}


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("width", list(TYPES))
@pytest.mark.parametrize(("stride", "offset"), [(0, 0), (0, 8), (68, 4)])
def test_accessors_of_every_kind(kind, width, stride, offset):
    values = np.arange(5 * width).reshape(5, width).astype(kind)
    document = opened(holding(values, stride=stride, offset=offset))
    found = document.accessor(0)
    np.testing.assert_array_equal(found, values)
    assert found.dtype == values.dtype
    assert document.accessor_count(0) == 5
    assert opened(holding(values[:0])).accessor(0).shape == (0, width)


def test_normalized_integers_span_their_range():
    extremes = np.array([[-128, -32, 64, 127]], "i1")
    assert opened(holding(extremes, normalized=True)).accessor(0).tolist() == [[-1.0, -32 / 127, 64 / 127, 1.0]]
    assert opened(holding(np.array([[0, 51, 255]], "u1"), normalized=True)).accessor(0).tolist() == [[0.0, 0.2, 1.0]]
    assert opened(holding(np.array([[0.5]], "<f4"), normalized=True)).accessor(0).tolist() == [[0.5]]


def sparse(values, rows, replacements, kind="<u2"):
    """Return a document in which ``rows`` of the values are replaced."""
    content = holding(values)
    for part in (np.array(rows, kind), replacements):
        content["bufferViews"].append({"buffer": len(content["buffers"]), "byteLength": part.nbytes})
        content["buffers"].append({"byteLength": part.nbytes, "uri": data_uri(part.tobytes())})
    indices = {"bufferView": 1, "componentType": KINDS[kind[1:]]}
    content["accessors"][0]["sparse"] = {"count": len(rows), "indices": indices, "values": {"bufferView": 2}}
    return content


def updated(content, change, *path):
    """Return a document whose entry at a path has other numbers."""
    place = content
    for key in path:
        place = place[key]
    place.update(change)
    return content


FIVE, NEW = np.arange(15, dtype="<f4").reshape(5, 3), np.array([[7, 8, 9]] * 2, "<f4")


def test_sparse_accessors_replace_rows_of_a_buffer_or_of_zeros():
    values, replacements = np.arange(12, dtype="<f4").reshape(4, 3), np.array([[7, 8, 9], [1, 1, 1]], "<f4")
    want = values.copy()
    want[[0, 3]] = replacements
    for kind in ("<u1", "<u2", "<u4"):
        content = sparse(values, [0, 3], replacements, kind)
        document = opened(content)
        for _ in range(2):  # the buffer itself is not changed
            np.testing.assert_array_equal(document.accessor(0), want)
        del content["accessors"][0]["bufferView"]
        want_zeros = np.where(np.isin(np.arange(4), [0, 3])[:, None], want, 0)
        np.testing.assert_array_equal(opened(content).accessor(0), want_zeros)


test_damaged_sparse_parts = refusing(
    lambda _, change: opened(
        updated(sparse(np.zeros((4, 3), "<f4"), [0, 3], NEW), change, "accessors", 0, "sparse")
    ).accessor(0)
)(
    ({"count": 0}, "has 0 entries of unusable type or number"),
    ({"count": 5}, "has 5 entries of unusable type or number"),
    ({"indices": None}, r"accessors\[0\] of 4 elements is sparse, but lacks indices or values"),
    ({"values": {}}, "lacks indices or values"),
    ({"indices": {"bufferView": 1, "componentType": 5126}}, "unusable type"),
    ({"indices": {"bufferView": 2, "componentType": 5125}}, "points at element 1090519040 of 4"),
    ({"values": {"bufferView": 1}}, "reaches beyond its buffer"),
    ({"values": {"bufferView": 9}}, "must be an index below 3"),
)


test_damaged_numbers = refusing(
    lambda _, collection, change: opened(updated(holding(FIVE), change, collection, 0)).accessor(0)
)(
    ("accessors", {"count": 6}, r"accessors\[0\] of 6 elements reaches beyond its buffer"),
    ("accessors", {"count": -1}, r"accessors\[0\] claims -1 elements"),
    ("accessors", {"count": True}, "'count' must be of type int, got bool"),
    ("accessors", {"count": 10**30}, "more than the size limit allows"),
    ("accessors", {"byteOffset": -4}, r"byteOffset of accessors\[0\] of 5 elements is -4"),
    ("accessors", {"byteOffset": 4}, "reaches beyond its buffer"),
    ("accessors", {"componentType": 5124}, "unknown type 5124"),
    ("accessors", {"componentType": [5126]}, r"unknown type \[5126\]"),
    ("accessors", {"type": "VEC5"}, "must be SCALAR or VEC2 .* got 'VEC5'"),
    ("accessors", {"type": {}}, "got {}"),
    ("accessors", {"bufferView": None}, "has no data"),
    ("accessors", {"bufferView": True}, r"refers to bufferViews\[True\], but there are 1"),
    ("bufferViews", {"byteLength": 61}, r"bufferViews\[0\] reaches beyond its buffer of 60 bytes"),
    ("bufferViews", {"byteLength": 59}, "reaches beyond its buffer"),
    ("bufferViews", {"byteOffset": -1}, r"byteOffset of bufferViews\[0\] is -1"),
    ("bufferViews", {"byteStride": 13}, "reaches beyond its buffer"),
    ("bufferViews", {"byteStride": -12}, "byteStride of .* is -12"),
    *(("bufferViews", {"byteStride": stride}, "byteStride|reaches beyond") for stride in (10**300, 2**62)),
    ("bufferViews", {"buffer": 1}, "the buffer of .* must be an index below 1"),
    ("buffers", {"byteLength": 61}, "buffer 0 should have 61 bytes, got 60"),
    ("buffers", {"byteLength": -1}, "byteLength of buffer 0 is -1"),
    ("buffers", {"uri": None}, "neither an address nor a binary chunk"),
    ("buffers", {"uri": 5}, "'uri' must be of type str"),
    ("buffers", {"uri": "data:text/plain,abcd"}, "must be base64: 'data:text/plain'"),
    ("buffers", {"uri": "data:a;base64,%%%"}, "not valid base64"),
)


def test_accessors_name_what_they_hold_and_must_be_of_the_types_asked_for():
    document = opened(holding(np.zeros((2, 3), "<f4")))
    assert document.accessor(0, "POSITION", ("VEC3",)).shape == (2, 3)
    content = holding(np.zeros((4, 3), "<f4"))
    assert opened(content, limits=FileLimits(max_bytes=48)).accessor(0).shape == (4, 3)
    few = opened(content, limits=FileLimits(max_bytes=47))
    refused(
        (lambda: document.accessor(0, "JOINTS_0", ("VEC4",)), "JOINTS_0 must be VEC4, got 'VEC3'"),
        (lambda: document.accessor(None, "JOINTS_0"), "the accessor of JOINTS_0 must be an index below 1"),
        (lambda: few.accessor(0), "has 4 elements, more than the size limit allows"),
    )


def test_buffers_lie_in_the_folder_or_below(tmp_path):
    folder = tmp_path / "in"
    (folder / "sub").mkdir(parents=True)
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    for place in (folder / "sub" / "my data.bin", tmp_path / "outside.bin"):
        place.write_bytes(values.tobytes() + b"trailing")
    (folder / "link.bin").symlink_to(tmp_path / "outside.bin")
    content = holding(values)

    def read(uri):
        content["buffers"][0]["uri"] = uri
        return opened(content, folder / "a.gltf").accessor(0)

    np.testing.assert_array_equal(read("sub/my%20data.bin"), values)
    np.testing.assert_array_equal(read("sub/../sub/my data.bin"), values)
    for uri in (
        "../outside.bin", "link.bin", str(tmp_path / "outside.bin"), "%2e%2e/outside.bin", "http://host/a.bin",
        "http%3A//host/a", "file:///etc/passwd", "//host/a.bin", "s3:/b/c", "..\\outside.bin", "a%00b", "C:/a.bin",
        "\ud800.bin",
    ):  # fmt: skip
        refused((lambda uri=uri: read(uri), r"refers to the buffer .* must lie in the file's folder"))
    refused(
        (lambda: read("none.bin"), r"'none\.bin' cannot be read: it is not there"),
        (lambda: read("sub"), r"'sub' cannot be read \("),
    )


def container(*chunks, version=2, extra=0):
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", version, 12 + len(body) + extra) + body


def test_containers_hold_json_and_one_binary_chunk():
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    content = holding(values)
    del content["buffers"][0]["uri"]
    text = json.dumps(content).encode()
    for chunks in (
        [(b"JSON", text), (b"BIN\0", values.tobytes())],
        [(b"JSON", text), (b"MINE", b"skipped"), (b"BIN\0", values.tobytes()), (b"BIN\0", b"second")],
    ):
        np.testing.assert_array_equal(opened(container(*chunks)).accessor(0), values)
    for damaged, words in (
        (b"glTF", "has at least 20 bytes, got 4"),
        (container((b"JSON", text), version=1), "says version 1"),
        (container((b"JSON", text), extra=1), "cut off or damaged"),
        (container((b"JSON", text)) + b"\0", "cut off or damaged"),
        (container((b"BIN\0", b"abcd"), (b"JSON", text)), r"must begin with a JSON chunk, got b'BIN\\x00'"),
        (container((b"JSON", text))[:12] + struct.pack("<I", 10**6) + container((b"JSON", text))[16:], "byte 12"),
    ):
        refused((lambda damaged=damaged: opened(damaged), words))


test_what_is_no_document = refusing(lambda _, content: opened(content))(
    (b"{", "not a readable glTF document"),
    (b"\xff\xfe", "not a readable glTF document"),
    (b"[" * 100_000, "not a readable glTF document"),
    (b"1" * 10_000, "not a readable glTF document|must be glTF"),
    (b"[]", "must be glTF of version 2, whose JSON is an object; got list"),
    (b'{"extensionsRequired": 3}', "'extensionsRequired' must be of type list, got int"),
    (b'{"extensionsRequired": ["EXT_meshopt_compression"]}', "needs the extension EXT_meshopt_compression"),
)


def test_entries_have_types_and_null_is_missing():
    document = opened({"nodes": [{"a": 1, "b": None, "c": True}, 5]})
    node = document.item("nodes", 0)
    assert [document.entry(node, *key) for key in (("a", int), ("b", int), ("b", int, 4))] == [1, 0, 4]
    assert document.items("meshes") == []
    refused(
        (lambda: document.entry(node, "c", int), "the entry 'c' must be of type int, got bool"),
        (lambda: document.item("nodes", 1), r"nodes\[1\] must be an object"),
        (lambda: document.items("nodes"), "nodes must be a list of objects"),
        (lambda: document.index("nodes", -1, "a child"), r"a child must be an index below 2: it refers to nodes\[-1\]"),
    )


def test_nodes_move_their_children_in_any_order():
    nodes = [{"translation": [0, 0, 1]}, {"children": [0], "scale": [2, 2, 2]}]
    nodes.append({"children": [1], "translation": [5, 0, 0]})
    document = opened({"nodes": nodes})
    parents = document.node_parents()
    assert parents == [1, 2, -1]
    assert document.node_globals(parents)[0][:3, 3].tolist() == [5, 0, 2]
    assert opened({}).node_globals([]).shape == (0, 4, 4)


test_impossible_nodes = refusing(
    lambda _, nodes: (found := opened({"nodes": nodes})).node_globals(found.node_parents())
)(
    ([{"children": [1]}, {"name": "tip", "children": [0]}], ModelError, "cyclic at 0, 'tip'"),
    ([{"children": [0]}], ModelError, "cyclic at 0"),
    ([{"children": [2]}, {"children": [2]}, {}], ModelError, "node 2 has two parents"),
    ([{"children": [1]}], FormatError, "a child of node 0 must be an index below 1"),
    ([{"rotation": [0, 0, 0, 0]}], ModelError, "the rotation of node 0 is a zero quaternion"),
    ([{"scale": [1, 2]}], FormatError, r"the scale of node 0 must hold 3 numbers, got \[1, 2\]"),
    ([{"scale": [1, 2, "3"]}], FormatError, "the scale of node 0 must hold 3 numbers"),
    ([{"scale": [1, 2, True]}], FormatError, "the scale of node 0 must hold 3 numbers"),
    ([{"matrix": [1]}], FormatError, "the matrix of node 0 must hold 16 numbers"),
    ([{"name": "a", "translation": [0, 1e301, 0]}], ModelError, "the translation of node 'a' is not finite"),
    ([{"translation": [0, float("nan"), 0]}], ModelError, "the translation of node 0 is not finite"),
    ([{"translation": [0, 10**400, 0]}], ModelError, "the translation of node 0 is not finite"),
)
