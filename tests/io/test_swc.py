"""SWC there and back, files written by others, and damaged ones."""

import pytest
import torch

import torchreg as tr
from tests.io.helpers import put
from tests.tables import refused, refusing
from torchreg.io.swc import load_swc, save_swc


def made(seed=0, count=12):
    generator = torch.Generator().manual_seed(seed)
    parents = [int(torch.randint(0, node, (1,), generator=generator)) for node in range(1, count)]
    edges = torch.tensor([[parent, node] for node, parent in enumerate(parents, start=1)])
    nodes = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return tr.Skeleton(nodes, edges, torch.rand(count, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("seed", range(3))
def test_a_tree_comes_back(tmp_path, seed):
    skeleton = made(seed)
    save_swc(tmp_path / "a.swc", skeleton, "two\nlines")
    again = load_swc(tmp_path / "a.swc")
    assert again.topology == skeleton.topology
    order = torch.cdist(skeleton.nodes, again.nodes).argmin(-1)
    torch.testing.assert_close(again.nodes[order], skeleton.nodes, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(again.radii[order], skeleton.radii, rtol=1e-8, atol=1e-9)
    there = {frozenset(edge) for edge in order[skeleton.edges].tolist()}
    assert there == {frozenset(edge) for edge in again.edges.tolist()}


def test_parents_come_first_and_types_tell_ends_and_branchings(tmp_path):
    star = tr.Skeleton(torch.randn(4, 3), torch.tensor([[0, 3], [1, 3], [2, 3]]), torch.ones(4))
    save_swc(tmp_path / "a.swc", star)
    refused((lambda: save_swc(tmp_path / "a.txt", star), r"must end in \.swc"), error=tr.errors.InputError)
    rows = [line.split() for line in (tmp_path / "a.swc").read_text().splitlines() if not line.startswith("#")]
    assert all(int(row[6]) < int(row[0]) for row in rows)
    assert [row[1] for row in rows] == ["6", "5", "6", "6"]
    assert [row[6] for row in rows].count("-1") == 1


def test_files_of_others_are_read(tmp_path):
    text = "# from elsewhere\n\n10 1 0 0 0 1.5 -1\n12 3 1 0 0 .5 10 # dendrite\n11 3 2 0 0 0.25 12\n"
    skeleton = load_swc(put(tmp_path, "a.swc", text))
    assert skeleton.edges.tolist() == [[0, 1], [1, 2]]
    assert skeleton.radii.tolist() == [1.5, 0.5, 0.25]


test_damaged_swc = refusing(lambda folder, content: load_swc(put(folder, "bad.swc", content)), file="bad.swc: ")(
    ("1 1 0 0 x 1 -1\n", "line 1 is no node"), ("1 1 0 0 0 1 -1\n2 1 0 0 0 1 7\n", "make no tree"),
    ("1 1 0 0 0 1 -1\n2 1 0 0 0 1 -1\n", "make no tree"), ("1 1 0 0 nan 1 -1\n", "make no tree"),
    ("1 1 0 0 0 1\n", "line 1 is no node .6 columns"),
    ("", "make no tree"),
)  # fmt: skip
