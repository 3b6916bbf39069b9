"""One figure or table of a paper as a trial: pictures among its artifacts, numbers among its metrics."""

from __future__ import annotations

from collections.abc import Callable

from ..errors import SkippedTrial
from ..papers import alignment_figures, registration_figures, spine_figures
from ..papers.blocks import BLOCKS
from ..registry import Bench, TrialOutcome
from ..schema import PaperTrial

MAKERS: dict[str, Callable[[PaperTrial, Bench], TrialOutcome]] = {
    **alignment_figures.MAKERS,
    **registration_figures.MAKERS,
    **spine_figures.MAKERS,
}


def run(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Return the pictures and numbers of a block.

    Raises:
        SkippedTrial: if it is not made again, saying why.
    """
    why_not = {block.id: block.why_not for block in BLOCKS}.get(config.block, "the papers have no such figure")
    if config.block not in MAKERS:
        raise SkippedTrial(why_not or "it is made of the pairs that were registered for it")
    return MAKERS[config.block](config, bench)
