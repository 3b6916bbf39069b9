"""How many threads torch uses while the work is on many small tensors."""

import threading

import pytest
import torch

from torchreg.pipelines.threads import one_thread


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_there_is_one_thread_inside_and_as_many_as_before_after():
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


def test_the_number_comes_back_after_an_error():
    with pytest.raises(RuntimeError, match="inside"), one_thread():
        raise RuntimeError("inside")
    assert torch.get_num_threads() == 2


def test_threads_that_overlap_get_their_numbers_back():
    entered, leave, found = threading.Event(), threading.Event(), []

    def other():
        torch.set_num_threads(2)
        with one_thread():
            entered.set()
            leave.wait(10)
        found.append(torch.get_num_threads())

    thread = threading.Thread(target=other)
    with one_thread():
        thread.start()
        assert entered.wait(10)
    assert torch.get_num_threads() == 2
    leave.set()
    thread.join(10)
    assert found == [2]
    assert torch.get_num_threads() == 2


def test_a_decorated_function_may_call_itself():
    @one_thread()
    def count(depth):
        return [torch.get_num_threads(), *(count(depth - 1) if depth else [])]

    assert count(2) == [1, 1, 1]
    assert torch.get_num_threads() == 2


def test_large_work_keeps_all_threads():
    with one_thread(False):
        assert torch.get_num_threads() == 2
    with one_thread(), one_thread(False):
        assert torch.get_num_threads() == 1
