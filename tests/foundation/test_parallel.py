"""Work in threads that stays in order, with as many threads as the kernels have."""

import threading
import time

import numba
import numpy as np
import pytest

from lvba import parallel
from lvba.camera import Camera
from lvba.visual import image


def test_results_come_in_order_whatever_takes_longest():
    def work(item):
        time.sleep(0.01 * (5 - item % 5))
        return item * item

    assert list(parallel.in_order(work, range(12), threads=4)) == [k * k for k in range(12)]


def test_only_a_few_items_are_taken_ahead():
    taken = []

    def items():
        for k in range(100):
            taken.append(k)
            yield k

    stream = parallel.in_order(lambda k: k, items(), threads=2)
    assert next(stream) == 0
    assert len(taken) <= 5
    stream.close()
    assert threading.active_count() < 50


def test_an_error_reaches_the_caller():
    def work(item):
        if item == 3:
            raise ValueError("three")
        return item

    with pytest.raises(ValueError, match="three"):
        list(parallel.in_order(work, range(10)))


@pytest.mark.parametrize("threads", [1, numba.config.NUMBA_NUM_THREADS])
def test_images_are_read_by_as_many_threads_as_the_kernels_have(threads):
    """With fewer the test would wait for ever: so many are held until they are all there."""
    together, readers = threading.Barrier(threads, timeout=60), set()

    def read(index):
        readers.add(threading.get_ident())
        if index < threads:
            together.wait()
        return np.full((30, 40, 3), index, np.uint8)

    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        found = image.load_undistorted(read, threads + 6, Camera(40, 30, 30.0, 30.0, 19.5, 14.5))
    finally:
        numba.set_num_threads(before)
    assert len(readers) == threads
    assert found[:, 15, 20, 0].tolist() == list(range(threads + 6))


@pytest.mark.parametrize(("layer", "threads", "of_kernels"), [("omp", 2, 1), ("workqueue", 1, 2), ("", 1, 2)])
def test_parallel_kernels_have_no_more_threads_together_than_alone(monkeypatch, layer, threads, of_kernels):
    """With numba's own threads, and where its layer is not known yet, two may not enter kernels at once."""

    def known():
        if not layer:
            raise ValueError("Threading layer is not initialized.")
        return layer

    each_has = []
    monkeypatch.setattr(parallel, "threading_layer", known)
    monkeypatch.setattr(parallel, "get_num_threads", lambda: 2)
    monkeypatch.setattr(parallel, "set_num_threads", each_has.append)
    together, used = threading.Barrier(threads, timeout=60), set()

    def note(_):
        together.wait()
        used.add(threading.get_ident())

    list(parallel.in_order(note, range(4), parallel_kernels=True))
    assert len(used) == threads
    assert each_has == threads * [of_kernels]
