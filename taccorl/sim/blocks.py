"""Run work on N simulations in blocks, one block per thread. Useful for compiled code that releases Python's lock
(``numba.njit(nogil=True)``)."""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_LEAST = 4  # simulations in a block: handing over a block costs 20 µs, the touch of one simulation 40


class Blocks:
    """Pool of threads among which simulations are divided. With one thread or few simulations the caller does all the work."""

    def __init__(self, num_threads: int = 1) -> None:
        self.num_threads = num_threads
        self._pool: ThreadPoolExecutor | None = None

    def run(self, work: Callable[[int, int], object], num_sims: int) -> None:
        """Call ``work(start, end)`` for blocks that cover 0 … ``num_sims``; each call writes only the rows of its own block."""
        count = min(self.num_threads, num_sims // _LEAST)
        if count <= 1:
            work(0, num_sims)
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(
                self.num_threads - 1, thread_name_prefix="taccorl"
            )
        ends = [num_sims * k // count for k in range(count + 1)]
        others = [
            self._pool.submit(work, *block) for block in itertools.pairwise(ends[1:])
        ]
        work(0, ends[1])
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads; the next ``run`` starts new ones."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
