import json
import multiprocessing
import os
import signal

import pytest

from experiments.claims import claimed, is_claimed


def _hold(path, connection):
    with claimed(path, "s") as attempt:
        connection.send(attempt)
        connection.recv()


@pytest.fixture
def other(tmp_path):
    """A process that holds the claim at tmp_path / "c", and the pipe that ends it."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_hold, args=(tmp_path / "c", theirs))
    process.start()
    assert ours.recv() == 1
    yield process, ours
    process.kill()
    process.join()


def test_one_process_has_a_claim(tmp_path, other):
    process, pipe = other
    assert is_claimed(tmp_path / "c")
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 0
    pipe.send("done")
    process.join()
    assert not (tmp_path / "c").exists()
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 1


def test_a_killed_process_frees_its_claim_and_leaves_a_trace(tmp_path, other):
    process, _ = other
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not is_claimed(tmp_path / "c")
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 2
    assert not (tmp_path / "c").exists()


def test_every_session_counts_its_own_attempts(tmp_path):
    for session, expected in (("s", 1), ("s", 2), ("t", 1), ("t", 2)):
        with pytest.raises(KeyboardInterrupt), claimed(tmp_path / "c", session):
            raise KeyboardInterrupt
        assert json.loads((tmp_path / "c").read_text())["attempt"] == expected


def test_a_claim_file_without_sense_is_no_obstacle(tmp_path):
    (tmp_path / "c").write_bytes(b"\x00[")
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 1


def test_a_claim_taken_away_between_opening_and_locking_is_taken_anew(tmp_path, monkeypatch):
    import fcntl

    real, calls = fcntl.flock, []

    def steal(handle, how):
        if not calls:
            (tmp_path / "c").unlink()
        calls.append(handle)
        real(handle, how)

    monkeypatch.setattr(fcntl, "flock", steal)
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 1
        assert (tmp_path / "c").exists()
    assert len(calls) == 2
