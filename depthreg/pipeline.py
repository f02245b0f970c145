"""Reading, computing and writing at the same time: the next frames are read ahead, finished ones written behind.

    with WriteBehind() as write_behind:
        for sample in read_ahead(read, paths):
            write_behind(write, sample, network(sample))

What decodes and encodes pictures, OpenCV, lets other threads run meanwhile, and so does PyTorch.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Self, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def read_ahead(read: Callable[[Item], Result], items: Iterable[Item], ahead: int = 2) -> Iterator[Result]:
    """`map(read, items)`, with the next few items read on another thread in the meantime.

    Args:
        read: Reads an item. What it raises comes up at that item's turn, and ends the reading.
        items: What to read; drawn from this thread.
        ahead: How many results are held at most, beside the one that was given last.
    """
    thread = ThreadPoolExecutor(1, "read-ahead")
    coming: deque[Future[Result]] = deque()
    try:
        for item in items:
            coming.append(thread.submit(read, item))
            if len(coming) > ahead:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
    finally:
        thread.shutdown(cancel_futures=True)


class WriteBehind:
    """Writes on another thread, one after the other in the order given; the block's end waits for all of them.

    The first error comes up at one of the next calls, or else at the block's end, and nothing is written after it. What
    was handed over before anything else ends the block is still written.

    Args:
        behind: How many writes may wait; the next call waits for the oldest of them.
    """

    def __init__(self, behind: int = 2) -> None:
        self.behind = behind
        self._thread = ThreadPoolExecutor(1, "write-behind")
        self._pending: deque[Future[None]] = deque()
        self._failed = False

    def __call__(self, write: Callable[..., Any], *arguments: Any) -> None:
        """Call `write(*arguments)` later, which nobody may change until then."""
        while self._pending and (len(self._pending) > self.behind or self._pending[0].done()):
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(self._write, write, arguments))

    def _write(self, write: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        if self._failed:
            return
        try:
            write(*arguments)
        except BaseException:
            self._failed = True
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._thread.shutdown()
        if error is None:
            for write in self._pending:
                write.result()
