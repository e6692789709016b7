"""Commands to a vehicle, each repeated until it is answered."""

from collections import deque
from collections.abc import Hashable
from typing import Any, NamedTuple

from maniple.core.time import MILLISECOND, Duration, Time

AGAIN: Duration = 400 * MILLISECOND
"""A command that is not answered is sent again after so long,"""
TIMES = 4
"""so often in all."""

_ACCEPTED, _IN_PROGRESS = 0, 5


class Answer(NamedTuple):
    """What became of a command."""

    accepted: bool
    words: str
    """The name of the result, or that there was none."""
    at: Time


class _Sent(NamedTuple):
    key: Hashable
    message: Any
    at: Time
    times: int


class Commands:
    """Asks and remembers the answers, by keys of the caller's choice.

    An acknowledgement names the command only, so of each command one is under way at a time.
    """

    def __init__(self, dialect: Any, target: tuple[int, int]) -> None:
        self._dialect = dialect
        self._target = target
        self._waiting: dict[int, deque[tuple[Hashable, Any]]] = {}
        self._sent: dict[int, _Sent] = {}
        self._answers: dict[Hashable, Answer] = {}

    def ask(self, key: Hashable, command: int, *parameters: float) -> Answer | None:
        """The answer to a command; it is sent when it is asked for first."""
        answer = self._answers.get(key)
        if answer is not None or self._under_way(key, command):
            return answer
        message = self._dialect.MAVLink_command_long_message(
            *self._target, command, 0, *parameters, *[0.0] * (7 - len(parameters))
        )
        self._waiting.setdefault(command, deque()).append((key, message))
        return None

    def forget(self, key: Hashable, command: int) -> None:
        """Let it be asked anew; what is under way is given up."""
        self._answers.pop(key, None)
        if (sent := self._sent.get(command)) is not None and sent.key == key:
            del self._sent[command]
        if command in self._waiting:
            self._waiting[command] = deque(item for item in self._waiting[command] if item[0] != key)

    def answered(self, ack: Any, now: Time) -> None:
        """A COMMAND_ACK has arrived. Work in progress is waited for like no answer."""
        sent = self._sent.get(ack.command)
        if sent is None:
            return
        if ack.result == _IN_PROGRESS:
            self._sent[ack.command] = sent._replace(at=now)
            return
        del self._sent[ack.command]
        self._answers[sent.key] = Answer(ack.result == _ACCEPTED, self._words(ack.result), now)

    def due(self, now: Time) -> list[Any]:
        """What has to be sent now."""
        messages = []
        for command, sent in list(self._sent.items()):
            if now - sent.at < AGAIN:
                continue
            if sent.times >= TIMES:
                del self._sent[command]
                self._answers[sent.key] = Answer(False, f"no answer, asked {TIMES} times", now)
                continue
            sent.message.confirmation = sent.times
            self._sent[command] = sent._replace(at=now, times=sent.times + 1)
            messages.append(sent.message)
        for command, waiting in self._waiting.items():
            if waiting and command not in self._sent:
                key, message = waiting.popleft()
                self._sent[command] = _Sent(key, message, now, 1)
                messages.append(message)
        return messages

    def _under_way(self, key: Hashable, command: int) -> bool:
        sent = self._sent.get(command)
        return (sent is not None and sent.key == key) or any(
            item[0] == key for item in self._waiting.get(command, ())
        )

    def _words(self, result: int) -> str:
        entry = self._dialect.enums["MAV_RESULT"].get(result)
        return entry.name.removeprefix("MAV_RESULT_") if entry is not None else f"result {result}"
