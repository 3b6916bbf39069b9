"""Pairs of scans on disk as a network reads them: made once by several processes, and again only where some lack."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import torch
import typer
from torch import Tensor

from torchreg.registration.dense.scan_tokens import SIZES, ScanTokens

from ..made_up.creature_kinds import HELD_OUT_KINDS, TRAINING_KINDS
from ..made_up.creature_parts import Draw
from ..made_up.matching_pairs import MatchingPair, matching_pairs
from ..matcher.rigs import HELD_OUT_RIGS, drawn_bodies
from ..matcher.rigs import people as drawn_people

# Pairs in a file: some 12 MB, and half a minute of one process to make.
SHARD = 50
# Share of the pairs that show rigs and people, not made-up kinds.
_BODIES = 0.6
# Share of the pairs that show all sides, as complete meshes do.
_WHOLE = 0.25
# Share of the pairs with other things in them, and of the scans that are bare clouds.
_ROUGH = 0.35
# Steps of a geodesic distance as it is stored, in one byte.
_LEVELS = 255 / SIZES.farthest


@dataclass(frozen=True)
class PairBatch:
    """Pairs of scans, B of them, and where their tokens are on the other scan.

    Args:
        source: tokens of B scans.
        target: tokens of B scans.
        source_truth: (B, S, 3) in the coordinates of the target's tokens.
        source_visible: (B, S) bool.
        target_truth: (B, T, 3) in the coordinates of the source's tokens.
        target_visible: (B, T) bool.
        kinds: (B,) int64 numbers of kinds.
    """

    source: ScanTokens
    target: ScanTokens
    source_truth: Tensor
    source_visible: Tensor
    target_truth: Tensor
    target_visible: Tensor
    kinds: Tensor

    def rows(self, rows: slice) -> PairBatch:
        """Return some of the pairs."""
        return self._with(lambda value: value[rows])

    def to(self, device: str) -> PairBatch:
        """Return the batch on another device."""
        return self._with(lambda value: value.to(device))

    def _with(self, change: Callable[[Tensor], Tensor]) -> PairBatch:
        source, target = (
            ScanTokens(*(change(getattr(tokens, field.name)) for field in fields(ScanTokens)))
            for tokens in (self.source, self.target)
        )
        return PairBatch(source, target, *(change(getattr(self, field.name)) for field in fields(PairBatch)[2:]))


def kind_names() -> list[str]:
    """Return the names of all kinds, by number; further bodies have the last."""
    return [*TRAINING_KINDS, *HELD_OUT_KINDS, *sorted(HELD_OUT_RIGS), "body"]


def tokens_of_pair(pair: MatchingPair, generator: torch.Generator) -> PairBatch:
    """Return one pair as a network reads it."""
    source, target = (ScanTokens.from_scan(scan, generator) for scan in (pair.source, pair.target))
    index, target_index = source.token_index[0], target.token_index[0]
    names = kind_names()
    return PairBatch(
        source=source,
        target=target,
        source_truth=((pair.source_truth[index] - target.center) / target.scale).float()[None],
        source_visible=pair.source_visible[index][None],
        target_truth=((pair.target_truth[target_index] - source.center) / source.scale).float()[None],
        target_visible=pair.target_visible[target_index][None],
        kinds=torch.tensor([names.index(pair.kind) if pair.kind in names else len(names) - 1]),
    )


def make_shards(
    folder: Path,
    count: int,
    seed: int,
    workers: int,
    *,
    held_out: bool = False,
    rigs: Path | None = None,
    people: int = 0,
) -> list[Path]:
    """Return the files of so many pairs, after making those that lack.

    Args:
        folder: where they are.
        count: of pairs, rounded up to whole files.
        seed: of the stream.
        workers: processes that make them.
        held_out: of the kinds that are never trained on, instead of the others.
        rigs: folder of rigs (glTF) that are drawn as well, see `drawn_bodies`.
        people: of the body model anny that are drawn as well, in each file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"pairs_{seed}_{number:04d}.pt" for number in range(-(-count // SHARD))]
    missing = [number for number, file in enumerate(files) if not file.exists()]
    if missing:
        jobs = [(files[number], seed, number, held_out, rigs, people) for number in missing]
        with multiprocessing.get_context("spawn").Pool(min(workers, len(jobs))) as pool:
            for done, _ in enumerate(pool.imap_unordered(_make_shard, jobs), 1):
                typer.echo(f"{done} of {len(jobs)} files of pairs")
    return files


def _make_shard(job: tuple[Path, int, int, bool, Path | None, int]) -> None:
    file, seed, number, held_out, rigs, people = job
    torch.set_num_threads(1)
    # Unlike neighboring seeds, all draws of one generator are independent.
    seeds = torch.randint(2**62, (number + 1,), generator=torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(int(seeds[-1]))
    stream = _stream(int(seeds[-1]), held_out, rigs, people)
    batch = stacked([tokens_of_pair(next(stream), generator) for _ in range(SHARD)])
    part = file.with_suffix(".part")
    torch.save(_packed(batch), part)
    os.replace(part, file)


def _stream(seed: int, held_out: bool, rigs: Path | None, people: int) -> Iterator[MatchingPair]:
    drawn = drawn_people(Draw(torch.Generator().manual_seed(seed)), people) if people else []
    bodies = drawn_bodies(rigs, drawn, held_out=held_out)
    return matching_pairs(
        seed,
        HELD_OUT_KINDS if held_out else TRAINING_KINDS,
        bodies=bodies,
        body_share=_BODIES,
        whole=_WHOLE,
        rough=_ROUGH,
    )


def stacked(batches: list[PairBatch]) -> PairBatch:
    """Return several batches as one."""
    source, target = (ScanTokens.stack([getattr(batch, side) for batch in batches]) for side in ("source", "target"))
    tensors = (torch.cat([getattr(batch, field.name) for batch in batches]) for field in fields(PairBatch)[2:])
    return PairBatch(source, target, *tensors)


def _packed(batch: PairBatch) -> dict[str, Tensor]:
    """Return a batch in few bytes: half precision, and geodesics in steps."""
    values = {}
    for side in ("source", "target"):
        tokens = getattr(batch, side)
        for name in ("points", "normals", "boundary", "tokens", "neighbors", "geodesic"):
            value = getattr(tokens, name)
            if name == "geodesic":
                value = (value * _LEVELS).round().to(torch.uint8)
            elif name in ("tokens", "neighbors"):
                value = value.to(torch.int16)
            values[f"{side}.{name}"] = value.half() if value.is_floating_point() else value
        values[f"{side}.truth"] = getattr(batch, f"{side}_truth").half()
        values[f"{side}.visible"] = getattr(batch, f"{side}_visible")
    return {**values, "kinds": batch.kinds}


class PairStore:
    """Pairs of files in memory, to be drawn in batches.

    Args:
        files: made by `make_shards`; those that are not there are left out.
        device: where they are held, a quarter of a megabyte each, and given out.
    """

    def __init__(self, files: list[Path], device: str = "cpu") -> None:
        shards = [torch.load(file, weights_only=True) for file in files if file.exists()]
        self._values = {name: torch.cat([shard[name] for shard in shards]).to(device) for name in shards[0]}

    def __len__(self) -> int:
        return len(self._values["kinds"])

    def batch(self, rows: Tensor, swapped: Tensor | None = None) -> PairBatch:
        """Return pairs by their numbers (B,), source and target exchanged where ``swapped`` (B,) says so."""
        swapped = torch.zeros(len(rows), dtype=torch.bool) if swapped is None else swapped
        rows, swapped = (value.to(self._values["kinds"].device) for value in (rows, swapped))

        def both(name: str) -> tuple[Tensor, Tensor]:
            first, second = self._values[f"source.{name}"][rows], self._values[f"target.{name}"][rows]
            exchange = swapped.reshape(-1, *[1] * (first.ndim - 1))
            return torch.where(exchange, second, first), torch.where(exchange, first, second)

        pairs = {name: both(name) for name in ("points", "normals", "boundary", "tokens", "neighbors", "geodesic")}
        (source_truth, target_truth), (source_visible, target_visible) = both("truth"), both("visible")
        source, target = (_unpacked({name: pair[end] for name, pair in pairs.items()}) for end in (0, 1))
        return PairBatch(
            source=source,
            target=target,
            source_truth=source_truth.float(),
            source_visible=source_visible,
            target_truth=target_truth.float(),
            target_visible=target_visible,
            kinds=self._values["kinds"][rows],
        )


def _unpacked(values: dict[str, Tensor]) -> ScanTokens:
    count, device = len(values["points"]), values["points"].device
    return ScanTokens(
        points=values["points"].float(),
        normals=values["normals"].float(),
        boundary=values["boundary"],
        tokens=values["tokens"].long(),
        neighbors=values["neighbors"].long(),
        geodesic=values["geodesic"].float() / _LEVELS,
        index=torch.arange(values["points"].shape[1], device=device).expand(count, -1),
        center=torch.zeros(count, 3, device=device),
        scale=torch.ones(count, device=device),
    )
