"""From recorded messages to what is done one after the other when they are played. Pure."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TypeAlias

from maniple.core import topics
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.time import SECOND, Duration
from maniple.host.liveness import Life
from maniple.recording.reader import Recorded

SILENT: Duration = 5 * SECOND
"""A life that says nothing for longer is not there meanwhile, in time of the recording."""

MOST_AHEAD = 100_000
"""No more messages are looked ahead at to see who still speaks."""


Said: TypeAlias = tuple[Recorded, tuple[str, int] | None]
"""A message, and the life that said it, if it is one that shows itself."""

Cue: TypeAlias = Recorded | Life
"""A message is put, or a life appears or goes. A life belongs to the message beside it."""


def cues(messages: Iterable[Recorded], silent: Duration = SILENT) -> Iterator[Cue]:
    """The messages in their order; each life appears before its first and goes after its last. It goes and
    comes back, too, where it is `silent` in between."""
    ahead: deque[Said] = deque()
    coming: Counter[tuple[str, int]] = Counter()
    there: set[tuple[str, int]] = set()
    for message in chain(messages, (None,)):
        while ahead and (
            message is None
            or message.log_time_ns - ahead[0][0].log_time_ns > silent
            or len(ahead) >= MOST_AHEAD
        ):
            said, life = ahead.popleft()
            if life is None:
                yield said
                continue
            if life not in there:
                there.add(life)
                yield Life(*life, True)
            yield said
            coming[life] -= 1
            if not coming[life]:
                del coming[life]
                there.remove(life)
                yield Life(*life, False)
        if message is not None:
            life = _life_of(message)
            ahead.append((message, life))
            if life is not None:
                coming[life] += 1


def latched(messages: Iterable[Recorded]) -> tuple[Recorded, ...]:
    """The last of each latched topic, in their order: what a router has kept after these messages."""
    kept: dict[str, Recorded] = {}
    for message in messages:
        if is_latched(message.topic):
            kept.pop(message.topic, None)
            kept[message.topic] = message
    return tuple(kept.values())


def is_latched(name: str) -> bool:
    """Whether a name is that of a latched topic."""
    try:
        return topics.topic(name).latched
    except MessageError:
        return False


def is_order(name: str) -> bool:
    """Whether a topic tells robots to move or stop, or processes to fail: it has the priority "commands"."""
    try:
        return topics.topic(name).priority == "commands"
    except MessageError:
        return False


def _life_of(message: Recorded) -> tuple[str, int] | None:
    """The life that sent a message, where it alone may: others have no liveliness tokens."""
    try:
        header = header_of(message.topic, message.data)
        if header.incarnation > 0 and header.source in topics.senders_of(message.topic):
            return header.source, header.incarnation
    except MessageError:
        pass
    return None
