"""Threads meet at barriers and events, which only come apart if reading, computing and writing overlap."""

import threading
from collections.abc import Iterator

import pytest

from depthreg.pipeline import WriteBehind, read_ahead

PATIENCE_S = 30  # what would otherwise wait for ever fails


def test_results_come_in_order_and_each_once() -> None:
    assert list(read_ahead(str, range(50), ahead=3)) == [str(number) for number in range(50)]
    assert list(read_ahead(str, [])) == []


def test_the_next_item_is_read_while_this_one_is_worked_on() -> None:
    read = [threading.Event() for _ in range(4)]
    for number in read_ahead(lambda number: read[number].set() or number, range(4), ahead=2):
        later = read[min(number + 2, 3)]
        assert later.wait(PATIENCE_S)


def test_no_more_than_the_stated_number_is_read_ahead() -> None:
    drawn: list[int] = []

    def items() -> Iterator[int]:
        for number in range(20):
            drawn.append(number)
            yield number

    for given, _ in enumerate(read_ahead(str, items(), ahead=2), 1):
        assert len(drawn) <= given + 2


def test_what_reading_raises_comes_up_at_its_turn() -> None:
    results = read_ahead(lambda number: 6 // number, [3, 2, 1, 0, 6])
    assert [next(results) for _ in range(3)] == [2, 3, 6]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert list(results) == []


def test_reading_stops_when_nobody_asks_any_more() -> None:
    before = threading.active_count()
    results = read_ahead(str, range(1000))
    next(results)
    results.close()
    assert threading.active_count() == before


def test_writes_are_done_in_order_by_the_end_of_the_block() -> None:
    written: list[int] = []
    with WriteBehind() as write_behind:
        for number in range(50):
            write_behind(written.append, number)
    assert written == list(range(50))


def test_work_goes_on_while_something_is_written() -> None:
    both = threading.Barrier(2, timeout=PATIENCE_S)
    with WriteBehind() as write_behind:
        write_behind(both.wait)
        both.wait()  # nobody would come if the call had waited for the write


def test_only_so_many_writes_wait() -> None:
    may_write, third = threading.Event(), threading.Event()

    def hand_over() -> None:
        with WriteBehind(behind=1) as write_behind:
            for _ in range(3):
                write_behind(may_write.wait, PATIENCE_S)
            third.set()

    thread = threading.Thread(target=hand_over)
    thread.start()
    assert not third.wait(0.1)
    may_write.set()
    assert third.wait(PATIENCE_S)
    thread.join()


def test_a_failed_write_ends_the_block_and_nothing_is_written_after_it() -> None:
    written: list[int] = []

    def write(number: int) -> None:
        if number == 1:
            raise OSError("disk full")
        written.append(number)

    with pytest.raises(OSError, match="disk full"), WriteBehind() as write_behind:
        for number in range(3):
            write_behind(write, number)
    with pytest.raises(OSError, match="disk full"), WriteBehind() as write_behind:
        for number in range(100):
            write_behind(write, number)
    assert written == [0, 0]


def test_what_was_handed_over_is_written_whatever_ends_the_block() -> None:
    written: list[int] = []
    with pytest.raises(KeyboardInterrupt), WriteBehind() as write_behind:
        write_behind(written.append, 7)
        raise KeyboardInterrupt
    assert written == [7]
