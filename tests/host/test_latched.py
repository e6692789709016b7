"""What a platoon remembers of itself."""

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.messages import EmergencyStop
from maniple.host.latched import LatchedStore, Lives
from tests.host.nodes import command, odometry

TOPIC = "robot/r1/odometry"


def message(seq: int, incarnation: int = 1, source: str = "r1") -> bytes:
    made = odometry("r1")
    return codec.encode(msgspec.structs.replace(made, source=source, incarnation=incarnation, seq=seq))


def stop(incarnation: int, stopped: bool = True, source: str = "operator") -> bytes:
    return codec.encode(EmergencyStop(source=source, incarnation=incarnation, stopped=stopped))


def test_the_newest_message_is_kept() -> None:
    store = LatchedStore()
    assert store.answer(TOPIC) == {}
    kept = [store.keep(TOPIC, m) for m in (message(1), message(3), message(2), message(3))]
    assert kept == ["news", "news", "old", "old"]
    assert store.answer(TOPIC) == {TOPIC: message(3)}


@pytest.mark.parametrize(
    ("topic", "data", "why"),
    [
        (TOPIC, b"", "malformed"),
        (TOPIC, b"garbage", "malformed"),
        (TOPIC, codec.encode(msgspec.structs.replace(command(), source="r1", incarnation=9)), "malformed"),
        (TOPIC, codec.encode(odometry("r1", x_m=float("nan"), source="r1", incarnation=9)), "malformed"),
        (TOPIC, message(9, source="r2"), "sender"),
        ("robot/r1/command", codec.encode(command()), "malformed"),
        ("no/such/topic", message(9), "malformed"),
    ],
)
def test_garbage_takes_no_place(topic: str, data: bytes, why: str) -> None:
    """Not even with a header newer than all others."""
    store = LatchedStore()
    store.keep(TOPIC, message(1))
    assert store.keep(topic, data) == why
    assert store.answer(TOPIC) == {TOPIC: message(1)}


def test_a_newer_life_replaces_an_older_one() -> None:
    store = LatchedStore()
    for data in (message(70, incarnation=1), message(0, incarnation=2), message(71, incarnation=1)):
        store.keep(TOPIC, data)
    assert store.answer(TOPIC) == {TOPIC: message(0, incarnation=2)}


def test_a_life_that_never_showed_itself_waits_until_it_does() -> None:
    lives = Lives()
    store = LatchedStore(lives)
    lives.seen("r1", 1)
    assert store.keep(TOPIC, message(5)) == "news"
    assert store.keep(TOPIC, message(0, incarnation=2)) == "unannounced"
    store.announced()
    assert store.answer(TOPIC) == {TOPIC: message(5)}
    lives.seen("r1", 2)
    store.announced()
    assert store.answer(TOPIC) == {TOPIC: message(0, incarnation=2)}


def test_what_waits_takes_only_so_much_room() -> None:
    store = LatchedStore(Lives())
    for number in range(10_000):
        store.keep(f"robot/x{number}/odometry", message(0, source=f"x{number}"))
    assert len(store._waiting) < 1000
    assert store.all() == ()


def test_of_two_operators_the_later_counts_whatever_their_clocks() -> None:
    """The later one numbers its order above the one that is kept, as `maniple stop` does."""
    lives = Lives()
    store = LatchedStore(lives)
    ahead, behind = 2_000_000_000, 1_000_000_000
    assert store.keep(topics.STOP, stop(ahead)) == "news"
    assert store.keep(topics.STOP, stop(behind, stopped=False, source="second")) == "old"
    assert store.keep(topics.STOP, stop(max(behind, ahead + 1), stopped=False, source="second")) == "news"
    kept = store.message(topics.STOP)
    assert isinstance(kept, EmergencyStop)
    assert not kept.stopped
    assert store.message(topics.STOP) is kept


def test_lives_are_numbered_from_one_and_never_twice() -> None:
    lives = Lives()
    assert lives.next("r1") == 1
    lives.seen("r1", 4)
    lives.seen("r1", 2)
    assert lives.next("r1") == 5
    assert [lives.claim("r1"), lives.claim("r1"), lives.claim("r1", 9), lives.claim("r1")] == [5, 6, 9, 10]
    assert lives.claim("r1", 10) == 11  # it was there already, and gives none away
    assert lives.claim("r1", 11) == 11
    assert lives.all() == {"r1": 11}


def test_forged_names_take_only_so_much_room() -> None:
    lives = Lives()
    lives.seen("r1", 1)
    for number in range(10_000):
        lives.seen(f"x{number}", 1)
    lives.seen("r1", 2)
    assert len(lives.all()) < 5000
    assert lives.next("r1") == 3
