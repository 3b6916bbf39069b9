"""The page of the three papers: each figure and table has a block, and a maker or a reason why not."""

import re

import pytest

pytest.importorskip("jinja2", reason="experiments take the extra experiments")

from experiments.errors import SkippedTrial
from experiments.papers import command
from experiments.papers.blocks import BLOCK_IDS, BLOCKS, PAIR_SETS
from experiments.papers.table import case_name, table_rows
from experiments.papers.trial import MAKERS, run
from experiments.records import TrialRecord
from experiments.registry import Bench
from experiments.schema import PaperTrial


def test_there_is_a_block_for_every_figure_and_table_which_is_made_or_says_why_not(tmp_path):
    numbers = {"p1-fig": range(1, 4), "p2-fig": range(1, 13), "p3-fig": range(1, 8)}
    expected = {f"{name}-{number}" for name, row in numbers.items() for number in row}
    assert set(BLOCK_IDS) == expected | {"p1-timings", "p1-rivals", "p2-table-1", "p3-timings"}
    assert len([block for block in BLOCKS if not block.extra]) == 22
    for block in BLOCKS:
        assert (block.id in MAKERS or block.id == "p2-table-1") == (not block.why_not)
    for block, words in (("p2-fig-3", "a drawing of the method"), ("p4-fig-1", "the papers have no such figure")):
        with pytest.raises(SkippedTrial, match=words):
            run(PaperTrial(block=block), Bench("cpu", tmp_path))


def test_the_table_counts_first_tries_and_retries():
    records = {}
    for frame, (registered, first) in enumerate([(1.0, 1.0), (1.0, 0.0), (0.0, 0.0), (1.0, 1.0)]):
        metrics = {"registered": registered, "first_try": first, "error_percent": 0.5, "bones": 7.0}
        record = TrialRecord(str(frame), "registration", "1", {}, 0, "done", metrics, {"total": 2.0})
        records[case_name(PAIR_SETS[0], "paper", frame)] = record
    head, paper, ours, *_ = table_rows(records)
    assert paper[:4] == ("walk", "the paper", "189", "167 (88 %)")
    assert dict(zip(head, ours, strict=True)) == {
        "set": "walk", "": "as printed", "pairs": "4", "first try": "2 (50 %)", "95 %": "15 to 85 %",
        "after retries": "3 (75 %)", "mean error, %": "0.50", "bones": "7.0", "seconds a pair": "2.00",
    }  # fmt: skip


def test_a_run_writes_a_page_goes_on_and_says_what_is_missing(tmp_path, inline_engine, monkeypatch):
    monkeypatch.setattr(command, "BLOCK_IDS", ("p1-fig-2", "p2-fig-3"))
    monkeypatch.setattr(command, "pair_sweep", command.block_sweep)
    page = command.make_papers(command.PapersRun(tmp_path, smoke=True), lambda: inline_engine)
    text = page.read_text()
    sections = re.findall(r"<section[^>]*>", text)
    filled = {re.search(r'id="([^"]*)', tag)[1]: 'data-filled="yes"' in tag for tag in sections}
    assert tuple(filled) == BLOCK_IDS
    assert [name for name, is_filled in filled.items() if is_filled] == ["p1-fig-2"]
    sources = re.findall(r'src="([^"]{0,20})', text)
    assert sources
    assert all(source.startswith("data:image/png") for source in sources)
    summary = page.with_suffix(".txt").read_text()
    for line in (
        "p1-fig-2     reproduced   Sliding of the skin", "p2-fig-3     not: a drawing of the method",
        "p2-fig-4     not: it has not run yet",
    ):  # fmt: skip
        assert line in summary
    command.make_papers(command.PapersRun(tmp_path, smoke=True), lambda: inline_engine)
    assert sum(inline_engine.ran.values()) == 2
