import json
import math
from dataclasses import replace

import pytest

from experiments.errors import CorruptRecordError
from experiments.plan import planned_trials
from experiments.records import TrialRecord, parse_record, provenance


@pytest.fixture
def record(probe_sweep):
    trial = planned_trials(probe_sweep())[0]
    version = provenance()["versions"]["torchreg"]
    return TrialRecord(trial.id, "probe", version, trial.config, 0, "done", {"value": 0.1 + 0.2}, {"compute": 1e-3})


def test_a_record_comes_back_bit_for_bit(record):
    assert parse_record(record.to_json(), "x.json", record.id) == record


def test_numbers_that_json_does_not_know_become_none(record):
    odd = replace(record, metrics={"a": math.nan, "b": math.inf}, curves={"c": [1.0, math.nan]})
    found = parse_record(odd.to_json(), "x.json")
    assert (found.metrics, found.curves) == ({"a": None, "b": None}, {"c": [1.0, None]})


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\x00\x01", b'{"id": "x"}', b"[" * 100_000])
def test_what_is_no_record_is_said_so(content):
    with pytest.raises(CorruptRecordError, match=r"x\.json is not a record of a trial"):
        parse_record(content, "x.json")


def test_every_cut_of_a_record_is_noticed(record):
    whole = record.to_json()
    for length in range(0, len(whole), 97):
        with pytest.raises(CorruptRecordError):
            parse_record(whole[:length], "x.json")


def test_a_configuration_changed_afterwards_is_noticed(record):
    data = json.loads(record.to_json())
    data["config"]["scale"] = 7.0
    with pytest.raises(CorruptRecordError, match="configuration or version were changed after the trial ran"):
        parse_record(json.dumps(data).encode(), "x.json")


def test_the_record_of_another_trial_is_noticed(record):
    with pytest.raises(CorruptRecordError, match="holds the record of another trial"):
        parse_record(record.to_json(), "x.json", "0123")


def test_provenance_names_commit_host_and_versions():
    found = provenance()
    assert set(found["versions"]) >= {"torch", "numpy", "torchreg", "python"}
    assert found["host"]
    assert isinstance(found["commit"], str)
