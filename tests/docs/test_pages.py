"""The pages: every public name is documented, every page is reached, files and commands that they name exist.

Examples are run by ``sphinx-build -b doctest``, which ``.ci/run`` does.
"""

import importlib.util
import re
from pathlib import Path

import pytest
import typer

import torchreg
from torchreg.cli.application import app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
COMMANDS = set(typer.main.get_command(app).commands)
OWN = re.compile(r"(?<![\w/.])((?:torchreg|benchmarks|tests|configs|experiments|docs)/[\w./-]+\.\w+)")


def listed():
    return set(re.findall(r"^   (\w+)$", (DOCS / "api.md").read_text(encoding="utf-8"), flags=re.MULTILINE))


@pytest.mark.parametrize("name", sorted(set(torchreg.__all__) - {"__version__"}))
def test_every_public_name_is_documented(name):
    assert name in listed(), f"docs/api.md does not list {name}"
    assert (getattr(torchreg, name).__doc__ or "").strip(), f"{name} has no docstring"


def test_the_reference_lists_nothing_that_does_not_exist():
    modules = {path.stem for path in (ROOT / "torchreg" / "viz").glob("*.py")}
    assert listed() <= set(torchreg.__all__) | modules


def test_every_page_is_reached():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    reached = set(re.findall(r"^([\w/]+)$", index, flags=re.MULTILINE))
    assert {path.relative_to(DOCS).with_suffix("").as_posix() for path in PAGES} - {"index"} == reached


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_files_and_commands_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in OWN.findall(text):
        assert (ROOT / name).exists(), f"{page.name} names {name}, which does not exist"
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (page.parent / link).exists(), f"{page.name} links to {link}, which does not exist"
    for block in re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL):
        for command in re.findall(r"^(?:\.venv/bin/)?torchreg (\w+)", block, flags=re.MULTILINE):
            assert command in COMMANDS, f"{page.name} runs torchreg {command}, which does not exist"


def test_the_page_of_formats_is_made_from_the_readers():
    spec = importlib.util.spec_from_file_location("formats", DOCS / "formats.py")
    formats = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(formats)
    assert formats.PAGE.read_text(encoding="utf-8") == formats.page(), "run: python docs/formats.py"


def test_the_gallery_is_drawn_by_one_command(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("gallery", DOCS / "gallery.py")
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    gallery.main(["--smoke", "--output", str(tmp_path)])
    said = capsys.readouterr().out
    assert "captured data: skipped, no --data" in said
    drawn = {path.name for path in tmp_path.iterdir()}
    shown = set(re.findall(r"images/gallery/([\w.]+)", (DOCS / "gallery.md").read_text(encoding="utf-8")))
    assert drawn == shown
    assert shown <= {path.name for path in (DOCS / "images" / "gallery").iterdir()}
