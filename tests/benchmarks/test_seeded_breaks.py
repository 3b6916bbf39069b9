import pytest

SOURCE = """def near(a, b, c):
    limit = 0.5 * c
    return a - b < limit and c > 0
"""


@pytest.fixture(scope="module")
def bench(load):
    return load("seeded_breaks")


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "torchreg" / "room").mkdir(parents=True)
    (tmp_path / "torchreg" / "room" / "near.py").write_text(SOURCE)
    (tmp_path / "tests" / "room").mkdir(parents=True)
    (tmp_path / "tests" / "room" / "test_near.py").write_text(
        "from torchreg.room.near import near\n\ndef test_near():\n"
        "    assert near(1, 1, 1) and near(2, 1.6, 1) and not near(2, 1.4, 1) and not near(-9, 0, 0)\n"
    )
    return tmp_path


def test_each_break_is_another_program(bench, checkout):
    found = bench.drawn(20, 0, checkout)
    programs = {item.applied(SOURCE) for item in found}
    assert len(programs) == len(found) == 7
    assert "a + b < limit" in " ".join(programs)
    assert [item.text for item in bench.drawn(3, 7, checkout)] == [item.text for item in bench.drawn(3, 7, checkout)]


def test_a_break_is_noticed_by_the_test_of_its_module(bench, checkout):
    minus = next(item for item in bench.drawn(20, 0, checkout) if item.text == " + ")
    assert bench.tests_of(minus, checkout) == ["tests/room/test_near.py"]
    assert bench.outcome(minus, checkout, bench.tests_of(minus, checkout), 60) == "noticed"
    assert (checkout / minus.file).read_text() == SOURCE
    assert bench.outcome(minus, checkout, [], 60) == "MISSED"


def test_the_tests_that_run_the_line_of_a_break_are_found(bench, checkout):
    pytest.importorskip("pytest_cov")
    minus = next(item for item in bench.drawn(20, 0, checkout) if item.text == " + ")
    covered = bench.coverage_of(checkout, checkout / "covered.db")
    assert bench.covering(minus, checkout, covered) == ["tests/room/test_near.py::test_near"]
