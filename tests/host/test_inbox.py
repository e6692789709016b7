"""What arrived and is not yet dealt with."""

import time

from maniple.host.inbox import BUDGET, Arrived, Inbox, Item, Stop, Unfit
from maniple.host.liveness import Life


def test_everything_comes_out_in_order_and_with_its_time() -> None:
    inbox = Inbox()
    before = time.monotonic_ns()
    inbox.arrived("a", b"1")
    inbox.life("r1", 2, True)
    inbox.unfit("b", "huge")
    inbox.stop()
    first, *rest = inbox.take(0.0)
    assert isinstance(first, Arrived)
    assert (first.topic, first.data) == ("a", b"1")
    assert before <= first.monotonic_ns <= time.monotonic_ns()
    assert rest == [Life("r1", 2, True), Unfit("b", "huge"), Stop()]
    assert inbox.take(0.0) == ()
    assert inbox.take(-1.0) == ()


def test_a_flood_is_counted_but_takes_only_so_much_memory() -> None:
    inbox, size, count = Inbox(), 1 << 20, 500
    for _ in range(count):
        inbox.arrived("a", bytes(size))
    inbox.arrived("b", b"small")
    taken: list[Item] = []
    while items := inbox.take(0.0):
        taken += items
    kept = [item for item in taken if isinstance(item, Arrived) and item.topic == "a"]
    assert 0 < len(kept) * size <= BUDGET
    assert taken.count(Unfit("a", "flood")) == count - len(kept)
    assert isinstance(taken[-1], Arrived)  # what is small is still let in


def test_a_flood_is_taken_out_in_parts() -> None:
    inbox = Inbox()
    for _ in range(1000):
        inbox.arrived("a", b"")
    assert len(inbox.take(0.0)) < 500


def test_how_much_waits_is_known() -> None:
    inbox = Inbox()
    assert inbox.waiting == 0
    inbox.arrived("a", bytes(5000))
    inbox.arrived("a", b"what is small counts as 1 KiB")
    inbox.stop()
    assert inbox.waiting == 5000 + 1024
    inbox.take(0.0)
    assert inbox.waiting == 0
