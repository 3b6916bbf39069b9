"""What can be wrong with an experiment, told without a traceback by the command line."""

from __future__ import annotations


class ExperimentError(Exception):
    """Something that the person who runs experiments can put right."""


class ConfigError(ExperimentError, ValueError):
    """A configuration with an unknown key, a wrong type or a value out of range."""


class StoreError(ExperimentError, OSError):
    """A folder of results that cannot be read or written."""


class CorruptRecordError(ExperimentError, ValueError):
    """A file of a result that does not hold what it should."""


class SkippedTrial(Exception):
    """A trial needs something that is not here, such as an optional package or a folder of data."""
