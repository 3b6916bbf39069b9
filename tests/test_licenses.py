"""What torchreg depends on may be used by anyone: the list of licenses is complete, and none of them is GPL."""

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def licenses():
    path = Path(__file__).resolve().parents[1] / ".ci" / "licenses.py"
    spec = importlib.util.spec_from_file_location("licenses", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_all_dependencies_tell_a_license_that_is_allowed(licenses, capsys):
    code = licenses.main()
    told = capsys.readouterr()
    assert code == 0, told.err
    names = {row.split()[0].lower() for row in told.out.splitlines()}
    assert {"torch", "numpy", "scipy", "trimesh", "kornia"} <= names
    assert not names & {"plyfile", "pymeshlab", "igraph", "skeletor", "pymaxflow"}


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        ("GPL-3.0-only", True),
        ("GNU General Public License v3 (GPLv3)", True),
        ("GNU Affero General Public License", True),
        ("AGPL-3.0", True),
        ("LGPL-3.0-or-later", False),
        ("MIT", False),
    ],
)
def test_which_are_refused(licenses, text, refused):
    assert bool(licenses._REFUSED.search(text)) is refused
