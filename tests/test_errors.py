"""Every error can be caught as torchreg's own and as the builtin that callers already know."""

import inspect
import warnings

import pytest

from torchreg import errors

BUILTINS = {
    "InputError": ValueError,
    "InputTypeError": TypeError,
    "FormatError": ValueError,
    "ModelError": ValueError,
    "SolverError": RuntimeError,
    "MissingExtraError": ImportError,
}
CLASSES = [member for _, member in inspect.getmembers(errors, inspect.isclass)]


@pytest.mark.parametrize(("name", "builtin"), BUILTINS.items())
def test_errors_are_caught_as_builtins_and_as_torchreg_errors(name, builtin):
    kind = getattr(errors, name)
    for caught in (builtin, errors.TorchregError):
        with pytest.raises(caught, match="the message"):
            raise kind("the message")


def test_every_error_is_listed_here():
    raised = {kind.__name__ for kind in CLASSES if issubclass(kind, Exception) and not issubclass(kind, Warning)}
    assert raised == {*BUILTINS, "TorchregError"}


def test_warnings_can_be_silenced_together():
    assert issubclass(errors.TorchregWarning, UserWarning)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", errors.TorchregWarning)
        warnings.warn("millimeters?", errors.UnitsWarning, stacklevel=1)
    assert seen == []
    with pytest.warns(errors.TorchregWarning, match="millimeters"):
        warnings.warn("millimeters?", errors.UnitsWarning, stacklevel=1)


@pytest.mark.parametrize("kind", CLASSES)
def test_every_class_says_what_it_means(kind):
    assert kind.__doc__
    assert kind.__module__ == "torchreg.errors"
