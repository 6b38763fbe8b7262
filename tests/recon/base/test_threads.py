"""The one place for threads: linear algebra keeps out of the way of the program's own."""

import subprocess
import sys
import threading

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import recon  # noqa: F401 # with the libraries that it brings
from recon.base.threads import linear_algebra_on_one_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def _two() -> object:
    with linear_algebra_on_one_thread():
        pass  # all libraries are loaded
    with threadpool_limits(2, user_api="blas"):
        yield


def test_it_is_one_within_and_what_it_was_afterwards() -> None:
    seen = []

    @linear_algebra_on_one_thread()
    def inner() -> None:
        seen.append(threads())

    assert threads() == {2}
    with linear_algebra_on_one_thread():
        inner()
        seen.append(threads())
    assert seen == [{1}, {1}]
    assert threads() == {2}


def test_it_comes_back_after_an_error_and_when_the_last_has_ended() -> None:
    with pytest.raises(ZeroDivisionError), linear_algebra_on_one_thread():
        1 / 0  # noqa: B018
    assert threads() == {2}
    within, leave = threading.Event(), threading.Event()

    def other() -> None:
        with linear_algebra_on_one_thread():
            within.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with linear_algebra_on_one_thread():
        thread.start()
        assert within.wait(10)
    assert threads() == {1}
    leave.set()
    thread.join(10)
    assert threads() == {2}


def test_it_is_one_in_whichever_thread_asks_after_another() -> None:
    seen = []

    def ask() -> None:
        with linear_algebra_on_one_thread():
            seen.append(threads())

    ask()  # this thread lives on: libraries go on listening to it
    for thread in [threading.Thread(target=ask) for _ in range(2)]:
        thread.start()
        thread.join(10)
    ask()
    assert seen == [{1}] * 4
    assert threads() == {2}


@pytest.mark.skipif(sys.platform != "linux", reason="threads have priorities of their own on Linux only")
def test_threads_that_compute_let_the_main_one_go_first_where_a_window_asks_for_it() -> None:
    script = """
import os, threading
from recon.base import threads
def niceness(*_):
    seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
def compute():
    threads.in_blocks(niceness, 2)
def in_a_thread():
    other = threading.Thread(target=compute)
    other.start()
    other.join()
    told.append(list(seen))
    seen.clear()
seen, told = [], []
threads.set_threads(2)
main = os.getpriority(os.PRIO_PROCESS, os.getpid())
in_a_thread()
threads._pool.cache_clear()
threads.stand_back()
in_a_thread()
in_a_thread()  # by a thread that the pool has already
threads.set_threads(1)
compute()  # in the main thread itself
assert told[0] == [main] * 2, told
assert all(each > main for each in told[1] + told[2]), told
assert len(set(told[1] + told[2])) == 1, told
assert seen == [main], seen
"""  # in a process of its own: who stands back does so for good
    subprocess.run([sys.executable, "-c", script], check=True)
