"""The one place for threads: linear algebra keeps out of the way of the program's own."""

import os
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
import os, subprocess, sys, threading
from recon.base import threads
own = lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
def in_a_thread(work):
    other = threading.Thread(target=work)
    other.start()
    other.join()
def compute():
    threads.in_blocks(lambda *_: computing.append(own()), 2)
    asking.append(own())
    in_a_thread(lambda: asking.append(own()))
    asking.append(int(subprocess.check_output([sys.executable, "-c", "import os; print(os.nice(0))"])))
computing, asking = [], []
threads.set_threads(2)
main = own()
in_a_thread(compute)
assert computing == [main] * 2, computing
threads.stand_back()
in_a_thread(compute)
in_a_thread(compute)  # by threads that the pool has already
compute()  # asked for by the main thread itself
assert computing[2:] == [min(main + 10, 19)] * 6, computing
assert asking == [main] * 12, asking  # who asks, and what they begin
"""  # in a process of its own: who stands back does so for good
    main = os.getpriority(os.PRIO_PROCESS, 0)
    if main >= 19:
        pytest.skip("Nothing goes after this process.")
    try:
        subprocess.run([sys.executable, "-c", "import os; os.nice(1)"], check=True, capture_output=True)
    except subprocess.CalledProcessError:
        pytest.skip("No priorities in this sandbox.")
    subprocess.run([sys.executable, "-c", script], check=True)
