"""Exceptions and warnings of torchreg; each also derives from the builtin that callers already catch."""


class TorchregError(Exception):
    """Base class of every error that torchreg raises on purpose."""


class InputError(TorchregError, ValueError):
    """An argument has the wrong shape, size or value; the message names the argument."""


class InputTypeError(TorchregError, TypeError):
    """An argument has the wrong type or dtype; the message names the argument."""


class FormatError(TorchregError, ValueError):
    """A file is damaged, oversized or not what it says it is; the message names the file."""


class ModelError(TorchregError, ValueError):
    """A kinematic tree, rig or robot description is cyclic, disconnected, non-finite or otherwise unusable."""


class SolverError(TorchregError, RuntimeError):
    """A numerical method could not produce an answer within its bounded repairs."""


class MissingExtraError(TorchregError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class TorchregWarning(UserWarning):
    """Base class of torchreg's warnings."""


class DegenerateDataWarning(TorchregWarning):
    """The data lie at one place, on a line or on a plane, and do not determine the result."""


class PrecisionWarning(TorchregWarning):
    """The data lie so far from the origin that their dtype rounds them coarsely."""


class UnitsWarning(TorchregWarning):
    """The sizes of data and model differ so much that the units probably do too."""


class FramesWarning(TorchregWarning):
    """Frames were left out, as the shape was not surely found in them; the message names them."""


class OutputWarning(TorchregWarning):
    """What a command writes beside its result could not be drawn or written; the message names the file."""


class FileWarning(TorchregWarning):
    """Part of a file or of its data was left out, or read otherwise than it says; the message names it and counts."""
