"""Which messages are there and which are missing, by sequence number. Pure, and cheap for each message."""

from bisect import bisect_right
from collections.abc import Mapping

import msgspec

GAPS_NAME = "maniple.gaps"
"""The metadata record in which a recorder says at the end what its recording lacks."""

MOST_STREAMS = 1 << 16
"""Lives of senders on topics that are kept apart; names may be forged."""

_MOST_GAPS_TOLD = 100


class Gap(msgspec.Struct, frozen=True):
    """Sequence numbers that are missing, both ends included."""

    first: int
    last: int

    @property
    def missing(self) -> int:
        """How many they are."""
        return self.last - self.first + 1


class Stream(msgspec.Struct, frozen=True, kw_only=True):
    """The messages of one life of one sender on one topic; its `seq` counts from 0."""

    topic: str
    source: str
    incarnation: int
    sent: int
    """As the sender's journal says, or up to the highest `seq` seen where that is more."""
    recorded: int
    """Without those that were there before."""
    missing: int
    missed_first: int
    """How many are missing before the first one seen."""
    missed_last: int
    """How many are missing after the last one seen; what no journal tells leaves no sign."""
    repeated: int
    """Messages whose `seq` had been seen before."""
    gaps: tuple[Gap, ...]
    """All that is missing, in order."""


class Tally:
    """Counts messages, and what senders say that they have sent, in whatever order both come."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str, int], _Count] = {}
        self.untold = 0
        """Messages of streams that there was no room for."""

    def note(self, topic: str, source: str, incarnation: int, seq: int) -> None:
        """A message is there."""
        count = self._counts.get((topic, source, incarnation))
        if count is None and (count := self._begin(topic, source, incarnation)) is None:
            self.untold += 1
        elif seq == count.next:
            count.next = seq + 1
            count.noted += 1
        else:
            count.add(seq)

    def told(self, source: str, incarnation: int, sent: Mapping[str, int]) -> None:
        """A life says how many messages it has sent so far, by topic."""
        for topic, number in sent.items():
            count = self._counts.get((topic, source, incarnation)) or self._begin(topic, source, incarnation)
            if count is not None and number > count.sent:
                count.sent = number

    def streams(self) -> tuple[Stream, ...]:
        """The counts so far, sorted by topic, source and incarnation."""
        return tuple(count.stream(*key) for key, count in sorted(self._counts.items()))

    def to_metadata(self) -> dict[str, str]:
        """The counts so far as texts: of all together, and as JSON by "TOPIC SOURCE INCARNATION"."""
        streams = self.streams()
        total = {name: str(sum(getattr(stream, name) for stream in streams)) for name in _TOLD[:3]}
        return total | {
            f"{stream.topic} {stream.source} {stream.incarnation}": _as_json(stream) for stream in streams
        }

    def _begin(self, topic: str, source: str, incarnation: int) -> "_Count | None":
        if len(self._counts) >= MOST_STREAMS:
            return None
        count = self._counts[topic, source, incarnation] = _Count()
        return count


class _Count:
    """Which sequence numbers have been seen: all below `next` but those in the gaps."""

    __slots__ = ("_firsts", "_lasts", "next", "noted", "repeated", "sent")

    def __init__(self) -> None:
        self.next = self.noted = self.repeated = self.sent = 0
        self._firsts: list[int] = []
        self._lasts: list[int] = []

    def add(self, seq: int) -> None:
        """Note a sequence number that is not the next."""
        self.noted += 1
        if seq >= self.next:
            if seq > self.next:
                self._firsts.append(self.next)
                self._lasts.append(seq - 1)
            self.next = seq + 1
        elif not self._fill(seq):
            self.repeated += 1

    def _fill(self, seq: int) -> bool:
        """Take a late number out of its gap; False where it is in none."""
        i = bisect_right(self._firsts, seq) - 1
        if i < 0 or seq > self._lasts[i]:
            return False
        first, last = self._firsts[i], self._lasts[i]
        left = [(first, seq - 1)] if first < seq else []
        right = [(seq + 1, last)] if seq < last else []
        self._firsts[i : i + 1] = [first for first, _ in left + right]
        self._lasts[i : i + 1] = [last for _, last in left + right]
        return True

    def stream(self, topic: str, source: str, incarnation: int) -> Stream:
        """The counts so far."""
        sent = max(self.sent, self.next)
        gaps = [Gap(first, last) for first, last in zip(self._firsts, self._lasts, strict=True)]
        missed_first = gaps[0].missing if gaps and gaps[0].first == 0 else 0
        if sent > self.next:
            gaps.append(Gap(self.next, sent - 1))
        return Stream(
            topic=topic,
            source=source,
            incarnation=incarnation,
            sent=sent,
            recorded=self.noted - self.repeated,
            missing=sum(gap.missing for gap in gaps),
            missed_first=missed_first,
            missed_last=sent - self.next,
            repeated=self.repeated,
            gaps=tuple(gaps),
        )


_TOLD = ("sent", "recorded", "missing", "missed_first", "missed_last", "repeated")


def _as_json(stream: Stream) -> str:
    told: dict[str, object] = {name: getattr(stream, name) for name in _TOLD}
    told["gaps"] = [(gap.first, gap.last) for gap in stream.gaps[:_MOST_GAPS_TOLD]]
    if len(stream.gaps) > _MOST_GAPS_TOLD:
        told["more_gaps"] = len(stream.gaps) - _MOST_GAPS_TOLD
    return msgspec.json.encode(told).decode()
