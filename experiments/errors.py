"""Errors of experiments, which the command line prints without a traceback."""

from __future__ import annotations


class ExperimentError(Exception):
    """An error that the person who runs experiments can fix."""


class ConfigError(ExperimentError, ValueError):
    """A configuration with an unknown key, a wrong type or a value out of range."""


class StoreError(ExperimentError, OSError):
    """A folder of results that cannot be read or written."""


class CorruptRecordError(ExperimentError, ValueError):
    """A damaged file of a result."""


class SkippedTrial(Exception):
    """A trial needs a missing resource, such as an optional package or a folder of data."""
