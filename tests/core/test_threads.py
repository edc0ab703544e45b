"""Work on several cores: in order, no more results at hand than threads at work, and errors reach the caller."""

import threading

import pytest

from mdf_core.threads import in_threads


def test_results_come_in_the_order_of_the_items():
    assert list(in_threads(lambda item: item**2, range(100))) == [item**2 for item in range(100)]


def test_nothing_is_done_far_ahead_of_who_asks():
    done, lock = [], threading.Lock()

    def work(item):
        with lock:
            done.append(item)
        return item

    results = in_threads(work, range(1_000))
    assert next(results) == 0
    assert len(done) <= 8
    results.close()
    assert len(done) <= 8


def test_an_exception_of_the_work_reaches_who_asks():
    def work(item):
        if item == 3:
            raise ValueError(item)
        return item

    results = in_threads(work, range(10))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)
