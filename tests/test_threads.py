"""How many threads torch uses while the work is on many small tensors."""

import threading

import pytest
import torch

from torchreg._threads import one_thread, run_both


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


def test_large_work_keeps_all_threads():
    with one_thread(False):
        assert torch.get_num_threads() == 2
    with one_thread(), one_thread(False):
        assert torch.get_num_threads() == 1


def who():
    return (
        threading.current_thread(),
        torch.get_num_threads(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
    )


def test_two_calls_are_made_side_by_side():
    meet = threading.Barrier(2, timeout=10)

    def call():
        meet.wait()
        return who()

    with one_thread(), torch.no_grad():
        (here, *own), (there, *others) = run_both(call, call)
    assert here is threading.current_thread()
    assert there is not here
    assert own == others == [1, False, False]


@pytest.mark.parametrize("mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_gradients_are_recorded_beside_as_here(mode):
    with mode():
        (_, *own), (_, *others) = run_both(who, who)
    assert own == others


@pytest.mark.parametrize(("allowed", "most"), [(2, 2), (3, 3), (4, 4), (5, 4)])
def test_calls_within_calls_share_what_is_left(allowed, most):
    torch.set_num_threads(allowed)

    def pair():
        return run_both(who, who)

    with one_thread():
        found = [each[0] for two in run_both(pair, pair) for each in two]
        again = [each[0] for each in pair()]
    assert len(set(found)) == most
    assert len(set(again)) == 2


def test_an_error_of_either_call_is_raised_once_both_have_ended():
    ended = threading.Event()

    def fails():
        raise RuntimeError("inside")

    with pytest.raises(RuntimeError, match="inside"):
        run_both(fails, ended.set)
    assert ended.is_set()
    with pytest.raises(RuntimeError, match="inside"):
        run_both(int, fails)
    with one_thread():
        assert run_both(who, who)[1][0] is not threading.current_thread()


def in_new_thread(call):
    found = []
    thread = threading.Thread(target=lambda: found.append(call()))
    thread.start()
    thread.join(10)
    return found[0]


def test_a_thread_that_began_beside_such_work_leaves_the_number_as_it_was():
    used, others_done, leave = threading.Event(), threading.Event(), threading.Event()

    def beside():
        torch.get_num_threads()  # torch fixes the number of a thread on first use: 1, for now
        used.set()
        others_done.wait(10)
        with one_thread():
            pass
        leave.set()

    thread = threading.Thread(target=beside)
    with one_thread():
        thread.start()
        assert used.wait(10)
    others_done.set()
    assert leave.wait(10)
    thread.join(10)
    assert torch.get_num_threads() == 2
    assert in_new_thread(torch.get_num_threads) == 2


def test_a_second_thread_is_within_the_work_of_the_first():
    def inner():
        with one_thread():
            return torch.get_num_threads()

    with one_thread():
        assert run_both(inner, inner) == (1, 1)
        assert in_new_thread(torch.get_num_threads) == 1
    assert in_new_thread(torch.get_num_threads) == 2
