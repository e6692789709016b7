"""Orders to recorders and their answers, over a real network."""

from collections.abc import Iterator
from queue import SimpleQueue
from threading import Thread

import msgspec
import pytest

from maniple.host.inbox import Asked, Inbox
from maniple.host.recorder_orders import Answer, Order, order_all, own_name, read_order, take_orders
from maniple.transport.zenoh import ZenohSession
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "test"):
        yield address


def answer(name: str) -> bytes:
    return msgspec.json.encode(Answer(recorder=name, ok=True, state="paused", text="done", reason="lunch"))


def test_every_recorder_is_asked_and_may_take_its_time(endpoint: str) -> None:
    asked: SimpleQueue[Order | None] = SimpleQueue()
    inboxes = {name: Inbox() for name in ("b-2", "a-1")}
    with (
        ZenohSession.client(endpoint, "test") as recorders,
        ZenohSession.client(endpoint, "test") as operator,
    ):
        for name, inbox in inboxes.items():
            take_orders(recorders, name, inbox.asked)
        recorders.settle()

        def reply() -> None:
            for name, inbox in inboxes.items():
                (item,) = eventually(lambda inbox=inbox: inbox.take(0.1))  # type: ignore[misc]
                assert isinstance(item, Asked)
                asked.put(read_order(item.data))
                item.reply(answer(name))

        thread = Thread(target=reply)
        thread.start()
        order = Order("pause", "lunch", 1.5)
        found = order_all(operator, order, 10.0)
        thread.join()
    assert [one.recorder for one in found] == ["a-1", "b-2"]
    assert all((one.ok, one.state, one.reason) == (True, "paused", "lunch") for one in found)
    assert [asked.get(), asked.get()] == [order, order]


def test_nobody_answers(endpoint: str) -> None:
    with ZenohSession.client(endpoint, "test") as operator:
        assert order_all(operator, Order("resume"), 5.0) == ()


def test_garbage_is_no_answer_and_no_order(endpoint: str) -> None:
    with ZenohSession.client(endpoint, "test") as foe, ZenohSession.client(endpoint, "test") as operator:
        foe.serve("recorder/foe/order", lambda name: {name: b"\xff garbage"})
        foe.settle()
        assert order_all(operator, Order("resume"), 5.0) == ()
    for data in (b"", b"garbage", b"\xff", b'{"what": "explode"}', b'{"what": "keep", "after_s": "long"}'):
        assert read_order(data) is None
    assert read_order(b'{"what": "keep"}') == Order("keep")


def test_who_goes_before_the_answer_is_not_waited_for_by_the_recorder(endpoint: str) -> None:
    """Its reply reaches nobody, and is no error."""
    inbox = Inbox()
    with ZenohSession.client(endpoint, "test") as recorder:
        take_orders(recorder, "a-1", inbox.asked)
        recorder.settle()
        with ZenohSession.client(endpoint, "test") as operator:
            assert order_all(operator, Order("keep"), 0.2) == ()
        (item,) = eventually(lambda: inbox.take(0.1))
        assert isinstance(item, Asked)
        item.reply(answer("a-1"))


def test_the_name_of_a_recorder_fits_into_a_key() -> None:
    assert all(c.isalnum() or c in "-_" for c in own_name())
