"""A folder of results: one JSON file per trial, from which all other files can be made again.

trials/ID.json          the record of a trial, written whole or not at all
trials/ID.json.corrupt-N    what was found in its place and was no record; never deleted
claims/ID               who runs the trial at this moment
artifacts/ID/           pictures and models
sweep.json              the sweep as it was last started
collected.parquet       all records as one table
report.html             the report
"""

from __future__ import annotations

import errno
import itertools
import json
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchreg.io.atomic import write_atomic

from .claims import is_claimed
from .compose import from_data
from .errors import CorruptRecordError, StoreError
from .plan import canonical
from .records import TrialRecord, parse_record
from .schema import SweepConfig
from .structure import plain

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EROFS, errno.EACCES, errno.EPERM}
# What a crash may leave behind is swept away after an hour.
_STALE_SECONDS = 3600


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn an OSError while writing to ``path`` into a StoreError with a remedy."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        told = "; check the path"
        if error.errno in _FULL:
            told = "; free some space and give the same command again: finished trials are kept"
        elif error.errno in _FORBIDDEN:
            told = "; make the folder writable, or name another one with --results"
        raise StoreError(f"{path} cannot be written: {error.strerror or error}{told}") from error


@dataclass(frozen=True)
class Store:
    """The results of a sweep.

    Args:
        root: their folder.
    """

    root: Path

    @property
    def trials(self) -> Path:
        """The folder of records."""
        return self.root / "trials"

    @property
    def parquet(self) -> Path:
        """The table of all records."""
        return self.root / "collected.parquet"

    def record_path(self, trial: str) -> Path:
        """Return the file of a trial's record."""
        return self.trials / f"{trial}.json"

    def claim_path(self, trial: str) -> Path:
        """Return the file of a trial's claim."""
        return self.root / "claims" / trial

    def artifacts(self, trial: str) -> Path:
        """Return the folder of a trial's artifacts."""
        return self.root / "artifacts" / trial

    def prepare(self) -> None:
        """Make the folders, and check that they are writable.

        Raises:
            StoreError: if not, saying what to do.
        """
        with explained(self.root):
            for folder in (self.trials, self.root / "claims"):
                folder.mkdir(parents=True, exist_ok=True)
            probe = self.trials / f".probe-{secrets.token_hex(8)}"
            write_atomic(probe, b"probe")
            probe.unlink()
            for partial in self.trials.glob(".*.part"):
                self._remove_stale(partial)

    def _remove_stale(self, path: Path) -> None:
        try:
            if time.time() - path.stat().st_mtime > _STALE_SECONDS:
                path.unlink()
        except FileNotFoundError:
            pass  # another driver was faster

    def read(self, trial: str) -> TrialRecord | None:
        """Return the record of a trial, or None if there is none.

        Raises:
            CorruptRecordError: if the file is no record of this trial.
        """
        path = self.record_path(trial)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:  # a folder, among others
            raise CorruptRecordError(f"{path.name} is not a record of a trial: {error.strerror}") from error
        return parse_record(content, path.name, trial)

    def write(self, record: TrialRecord) -> None:
        """Write a record, whole or not at all; it is on the disk when this returns.

        Raises:
            StoreError: if it cannot be written.
        """
        with explained(self.record_path(record.id)):
            write_atomic(self.record_path(record.id), record.to_json())

    def set_aside(self, trial: str) -> Path:
        """Rename a corrupt record, and return the new name: nothing is deleted.

        Raises:
            StoreError: if it cannot be renamed.
        """
        path = self.record_path(trial)
        aside = next(name for number in itertools.count(1) if not (name := Path(f"{path}.corrupt-{number}")).exists())
        with explained(path):
            path.rename(aside)
        return aside

    def records(self) -> tuple[list[TrialRecord], list[CorruptRecordError]]:
        """Return all records in the order of their ids, and the corrupt files."""
        found, bad = [], []
        for path in sorted(self.trials.glob("*.json")):
            try:
                record = self.read(path.stem)
            except CorruptRecordError as error:
                bad.append(error)
            else:
                found += [record] if record is not None else []
        return found, bad

    def is_claimed(self, trial: str) -> bool:
        """Return whether a process runs a trial now."""
        return is_claimed(self.claim_path(trial))

    def write_sweep(self, sweep: SweepConfig) -> None:
        """Store the configuration of the sweep.

        Raises:
            StoreError: if it cannot be written.
        """
        content = json.dumps(plain(sweep), indent=1).encode()
        with explained(self.root / "sweep.json"):
            write_atomic(self.root / "sweep.json", content)

    def read_sweep(self) -> SweepConfig | None:
        """Return the stored configuration of the sweep, or None if there is none.

        Raises:
            StoreError: if the file is damaged.
        """
        path = self.root / "sweep.json"
        try:
            data: dict[str, Any] = json.loads(path.read_bytes())
            return from_data(data)
        except FileNotFoundError:
            return None
        except (ValueError, AttributeError, TypeError, RecursionError, OSError) as error:
            raise StoreError(
                f"{path} is damaged ({error}); delete it and start the sweep again, results stay"
            ) from error


def same_sweep(first: SweepConfig, second: SweepConfig) -> bool:
    """Return whether two sweeps have the same configuration."""
    return canonical(plain(first)) == canonical(plain(second))
