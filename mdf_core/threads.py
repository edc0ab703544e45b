"""Work in numpy and scipy, which let other threads run meanwhile, on several cores."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

_MOST_THREADS = 4  # bounds the memory

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """The results of `work` on each of `items`, in their order, each as soon as it is there.

    Whoever stops asking stops the work. An exception of `work` reaches whoever asks for its result. No more results
    are held than threads are at work.
    """
    threads, waiting = min(os.cpu_count() or 1, _MOST_THREADS), iter(items)
    with ThreadPoolExecutor(threads) as pool:
        futures = deque(pool.submit(work, item) for item in islice(waiting, threads))
        try:
            while futures:
                result = futures.popleft().result()
                futures.extend(pool.submit(work, item) for item in islice(waiting, 1))
                yield result
        finally:
            pool.shutdown(cancel_futures=True)
