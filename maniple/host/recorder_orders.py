"""What a running recorder can be asked from outside, and what it answers."""

import os
import platform
import re
import secrets
from collections.abc import Callable
from typing import Literal, TypeAlias

import msgspec

from maniple.core.time import Time
from maniple.transport.zenoh import ZenohSession

State: TypeAlias = Literal["recording", "paused", "rolling", "keeping"]
"""It writes down what it hears; it does not; it only remembers the last seconds; it writes those down, and
what comes now."""


class Order(msgspec.Struct, frozen=True):
    """What is asked of all recorders."""

    what: Literal["keep", "pause", "resume", "state"]
    reason: str = ""
    """For whoever reads the recording."""
    after_s: float = 0.0
    """How much longer `keep` goes on, in time of the run."""


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """What one recorder says to an order."""

    recorder: str
    """Its name: computer, process and a mark."""
    ok: bool
    """Whether it did what it was asked."""
    state: State
    """What it does now."""
    text: str
    """What it did, or why it did not."""
    meant: bool = True
    """Whether the order is for a recorder such as this."""
    file: str = ""
    """What it writes, or wrote, as the recorder calls it."""
    messages: int = 0
    """In what was kept so far."""
    first_ns: Time = 0
    """Log time of the first of them,"""
    last_ns: Time = 0
    """and of the last."""
    reason: str = ""
    """Why it is paused."""


_read_order = msgspec.json.Decoder(Order).decode
_read_answer = msgspec.json.Decoder(Answer).decode


def own_name() -> str:
    """A name that no other recorder of a platoon has, as a part of a key: computer, process and a mark, as
    containers may share the first two."""
    name = f"{platform.node() or 'recorder'}-{os.getpid()}-{secrets.token_hex(2)}"
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)


def take_orders(
    session: ZenohSession, name: str, asked: Callable[[bytes, Callable[[bytes], None]], None]
) -> None:
    """Pass on what the recorder of this name is asked; each takes `read_order` and a reply of an `Answer`."""
    session.serve_later(f"recorder/{name}/order", asked)


def read_order(data: bytes) -> Order | None:
    """An order in bytes, if it is one."""
    try:
        return _read_order(data)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None


def order_all(session: ZenohSession, order: Order, timeout_s: float) -> tuple[Answer, ...]:
    """Ask all recorders there are; those that answer in time, by name."""
    found = []
    for _, data in sorted(session.ask("recorder/*/order", timeout_s, msgspec.json.encode(order)).items()):
        try:
            found.append(_read_answer(data))
        except (msgspec.MsgspecError, UnicodeDecodeError):
            continue
    return tuple(found)
