import threading
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm.core.execution import Workers, available_threads, chunk_bounds, has_abandoned, ordered_map


@pytest.mark.parametrize("threads", [0, 1, 2, 5])
def test_results_come_in_the_order_of_the_items(threads):
    """Item 0 waits for item 1 wherever two run at once, so completion order is not item order."""
    second_done = threading.Event()

    def work(k):
        if k == 0 and threads > 1:
            assert second_done.wait(30)
        if k == 1:
            second_done.set()
        return k * k

    assert list(ordered_map(work, range(20), threads=threads)) == [k * k for k in range(20)]


@pytest.mark.parametrize("threads", [1, 3])
def test_an_exception_is_raised_in_its_place(threads):
    def work(k):
        if k == 3:
            raise KeyError("three")
        return k

    results = ordered_map(work, range(10), threads=threads)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError, match="three"):
        next(results)
    assert list(results) == []


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_items_are_drawn_lazily(threads):
    drawn = []

    def items():
        for k in range(100):
            drawn.append(k)
            yield k

    results = ordered_map(lambda k: k, items(), threads=threads, ahead=2)
    assert drawn == []
    for taken in range(1, 20):
        next(results)
        assert taken <= len(drawn) <= taken + threads + 2
    results.close()
    assert len(drawn) < 100


@pytest.mark.parametrize("threads", [1, 3])
def test_closing_early_leaves_no_thread_behind(threads):
    before = threading.active_count()
    results = ordered_map(lambda k: k, range(100), threads=threads)
    next(results)
    results.close()
    assert threading.active_count() == before


@pytest.mark.parametrize("threads", [1, 3])
def test_no_items_give_no_results(threads):
    assert list(ordered_map(lambda k: k, [], threads=threads)) == []


def test_at_most_so_many_run_at_once():
    running, most, lock = 0, 0, threading.Lock()
    together = threading.Barrier(3)

    def work(k):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        if k < 3:
            together.wait(30)  # three do run at once
        with lock:
            running -= 1

    list(ordered_map(work, range(30), threads=3, ahead=10))
    assert most == 3


def test_sums_over_fixed_chunks_do_not_depend_on_the_threads(rng):
    values = rng.normal(size=10_001) * 10.0 ** rng.integers(-8, 8, 10_001)

    def total(threads):
        parts = ordered_map(lambda b: float(values[b[0] : b[1]].sum()), chunk_bounds(len(values), 16), threads=threads)
        return sum(parts)

    assert total(1) == total(2) == total(7)


@given(st.integers(0, 500), st.integers(0, 60))
def test_chunks_partition_the_range_evenly(count, chunks):
    bounds = chunk_bounds(count, chunks)
    assert [k for start, stop in bounds for k in range(start, stop)] == list(range(count))
    assert all(a[1] == b[0] for a, b in pairwise(bounds))
    sizes = [stop - start for start, stop in bounds]
    assert len(bounds) == min(count, max(1, chunks))
    assert not sizes or (min(sizes) >= 1 and max(sizes) - min(sizes) <= 1)


def test_at_least_one_thread_is_available():
    assert 1 <= available_threads() <= 4096


@pytest.mark.parametrize("threads", [0, 1, 2, 5])
def test_workers_return_results_in_the_order_of_the_jobs(threads):
    """Job 0 waits for job 1 wherever two run at once, so completion order is not job order."""
    workers = Workers(threads)
    for _ in range(3):
        second_done = threading.Event()

        def work(k, second_done=second_done):
            if k == 0 and threads > 1:
                assert second_done.wait(30)
            if k == 1:
                second_done.set()
            return k * k

        assert workers.map(work, range(20)) == [k * k for k in range(20)]


def test_threads_of_workers_end_with_them():
    before = set(threading.enumerate())
    workers = Workers(3)
    workers.map(abs, range(20))
    mine = set(threading.enumerate()) - before
    assert mine
    del workers
    for thread in mine:
        thread.join(30)
        assert not thread.is_alive()


def test_an_exception_of_a_worker_is_raised():
    with pytest.raises(ZeroDivisionError):
        Workers(2).map(lambda k: 1 / k, [1, 0])


@pytest.mark.parametrize("abandons", [False, True])
def test_an_interruption_waits_for_what_is_at_work_only_where_that_matters(abandons):
    begun, go_on, done = threading.Event(), threading.Event(), []

    def work(k):
        if k == 0:
            begun.set()
            assert go_on.wait(30)
            done.append(k)
        if k == 1:
            assert begun.wait(30)
            if not abandons:
                threading.Timer(0.2, go_on.set).start()
            raise KeyboardInterrupt
        return k

    # The interruption comes by the second result, while the first item is at work.
    results = ordered_map(work, [1, 0, *range(2, 50)], threads=2, abandons=abandons)
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert has_abandoned() is abandons
    assert done == ([] if abandons else [0])
    go_on.set()
    for thread in threading.enumerate():
        if thread.name.startswith("abandonable"):
            thread.join(30)
    assert not has_abandoned()
