"""Outputs: endings, numbers, nothing overwritten unasked."""

from pathlib import Path

import pytest

from torchreg.cli.outputs import check_outputs, numbered, with_ending
from torchreg.errors import InputError
from torchreg.storage import load

QUICK = ("--search", "never")


def test_outputs_are_not_overwritten_unless_forced(run, error_of, folder, tmp_path):
    (tmp_path / "r.json").write_text("mine", encoding="utf-8")
    command = ("align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", *QUICK)
    assert "r.json exists; pass --force to overwrite it" in error_of(*command)
    assert (tmp_path / "r.json").read_text(encoding="utf-8") == "mine"
    assert run(*command, "--force", "--start", folder / "truth0.json").exit_code == 0
    assert load(tmp_path / "r.safetensors").pose.shape == (27,)


def test_endings_are_checked_or_added():
    assert with_ending(None, (".ply",)) is None
    assert with_ending(Path("a.PLY"), (".ply",)) == Path("a.PLY")
    assert with_ending(Path("a/r.1"), (".safetensors",), add=True) == Path("a/r.1.safetensors")
    with pytest.raises(InputError, match=r"p\.bmp must end in \.png, \.pdf; rename the output"):
        with_ending(Path("p.bmp"), (".png", ".pdf"))


def test_numbers_sort_as_they_count():
    assert numbered(None, 0, 3) is None
    assert numbered(Path("a/r.json"), 0, 1) == Path("a/r.json")
    names = [numbered(Path("a/r.json"), index, 12) for index in range(12)]
    assert names == sorted(names)
    assert (names[0], names[11]) == (Path("a/r_01.json"), Path("a/r_12.json"))


def test_outputs_need_a_folder_a_name_of_their_own_and_leave(tmp_path):
    free, taken = tmp_path / "free.ply", tmp_path / "taken.ply"
    taken.touch()
    check_outputs([free, None, None], force=False)
    check_outputs([free, taken], force=True)
    with pytest.raises(InputError, match=r"taken\.ply exists; pass --force to overwrite it"):
        check_outputs([free, taken], force=False)
    with pytest.raises(InputError, match=r"two outputs would be called .*free\.ply; rename one"):
        check_outputs([free, free], force=True)
    with pytest.raises(FileNotFoundError, match="does not exist; create it first"):
        check_outputs([tmp_path / "none" / "a.ply"], force=True)


@pytest.mark.parametrize(
    ("given", "made"),
    [
        ("out", "out.safetensors"),
        ("out.json", "out.safetensors"),
        ("out.glb", "out.safetensors"),
        ("a.v2", "a.v2.safetensors"),
    ],
)
def test_names_of_results_get_their_ending(given, made):
    assert with_ending(Path(given), (".safetensors",), add=True) == Path(made)


def test_a_result_is_not_called_like_another_kind_of_file():
    with pytest.raises(InputError, match=r"s5\.swc must end in \.glb; rename the output"):
        with_ending(Path("s5.swc"), (".glb",), add=True)
