"""Work on independent items in several processes, none of which outlives the one that started them."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection

import cv2

from depthreg.errors import InputError


def core_count() -> int:
    """How many cores this process may use, which a cluster's scheduler can make fewer than there are."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def do_each(task: Callable[[int], None], items: Sequence[int], workers: int) -> Iterator[int]:
    """Do a task for each item; gives an item once it is done. The first error ends it, after the items in work.

    Args:
        task: Can be pickled.
        items: What to do it for.
        workers: Processes; one is this process itself.

    Raises:
        InputError: A worker was killed.
    """
    if workers <= 1:
        for item in items:
            task(item)
            yield item
        return
    # Not plain forks: this process may have threads (Ray's, a progress bar's), whose locks a fork would copy.
    context = multiprocessing.get_context("spawn" if sys.platform == "win32" else "forkserver")
    if sys.platform != "win32":
        context.set_forkserver_preload([type(task).__module__])  # imports once, not once a worker
    with ProcessPoolExecutor(workers, context, initializer=_begin_worker) as pool:
        futures = {pool.submit(task, item): item for item in items}
        try:
            for future in as_completed(futures):
                future.result()
                yield futures[future]
        except BrokenProcessPool as error:
            raise InputError("a worker was killed, as for want of memory: expected fewer workers") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Finish the item in work when the user interrupts, but end at once when the parent is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
