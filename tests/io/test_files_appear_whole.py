"""A file is the old one or the new one, whatever interrupts the writing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.io.helpers import put
from tests.tables import refused
from torchreg.io.atomic import write_atomic


@pytest.mark.parametrize("content", [b"", b"a\r\nb\0\xff", bytes(range(256)) * 4096])
def test_content_is_written_byte_for_byte_and_alone(tmp_path, content):
    path = tmp_path / "name with ü.tar.gz"
    write_atomic(path, content)
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_longer_old_file_is_replaced_whole_and_who_has_it_open_keeps_reading_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a name without folder is taken from the working folder
    path = Path("f")
    path.write_bytes(b"old" * 1000)
    with path.open("rb") as stream:
        write_atomic(path, b"new")
        assert stream.read() == b"old" * 1000
    assert (tmp_path / "f").read_bytes() == b"new"


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("old", [None, b"old"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, step, error, old):
    path = tmp_path / "f"
    if old is not None:
        path.write_bytes(old)

    def fail(*_):
        raise error("stopped here")

    with monkeypatch.context() as patch:
        patch.setattr(os, step, fail)
        with pytest.raises(error, match="stopped here"):
            write_atomic(path, b"new")
    assert [(place.name, place.read_bytes()) for place in tmp_path.iterdir()] == ([("f", old)] if old else [])
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_killed_process_leaves_the_old_file(tmp_path, step):
    path = tmp_path / "f"
    path.write_bytes(b"old")
    program = (
        "import os, pathlib, runpy, sys\n"
        "write = runpy.run_path(sys.argv[1])['write_atomic']\n"
        f"os.{step} = lambda *_: os._exit(9)\n"
        "write(pathlib.Path(sys.argv[2]), b'new')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-I", "-c", program, sys.modules[write_atomic.__module__].__file__, str(path)],
        check=False,
        timeout=60,
    )
    assert ended.returncode == 9
    assert path.read_bytes() == b"old"
    # What is left over is hidden and named like nothing that a loader takes.
    assert all(place.name.startswith(".f.") and place.suffix == ".part" for place in {*tmp_path.iterdir()} - {path})


def test_permissions_of_the_old_file_stay_and_new_files_follow_the_umask(tmp_path):
    path = tmp_path / "f"
    write_atomic(path, b"old")
    (tmp_path / "plain").write_bytes(b"")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    path.chmod(0o640)
    write_atomic(path, b"new")
    assert path.stat().st_mode & 0o777 == 0o640


def test_the_bytes_reach_the_disk_before_the_name_and_the_folder_after(tmp_path, monkeypatch):
    steps, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (steps.append("fsync"), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda *names: (steps.append("replace"), replace(*names)))
    write_atomic(tmp_path / "f", b"new")
    assert steps == ["fsync", "replace", "fsync"]


def test_places_that_cannot_be_written(tmp_path):
    put(tmp_path, "file", "old")
    refused((lambda: write_atomic(tmp_path, b""), r"is a folder; name a file in it"), error=IsADirectoryError)
    refused(
        (lambda: write_atomic(tmp_path / "none" / "f", b""), "the folder .*none does not exist; create it first"),
        (lambda: write_atomic(tmp_path / "file" / "f", b""), "does not exist"),
        error=FileNotFoundError,
    )
    assert [place.name for place in tmp_path.iterdir()] == ["file"]
