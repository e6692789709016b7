from collections.abc import Iterator

import pytest

from maniple.core.time import SECOND
from maniple.host.liveness import Life
from maniple.host.playing import cues as module
from maniple.host.playing.cues import cues, is_latched, is_order, latched
from maniple.recording.reader import Recorded
from tests.recording.traffic import drive


def said(at_s: float, source: str = "r1", incarnation: int = 1, topic: str = "") -> Recorded:
    time = round(at_s * SECOND)
    return Recorded(topic or f"hw/{source}/drive", drive(0, source, incarnation), time, time, 0)


def shown(messages: list[Recorded]) -> list[str]:
    """+r1/1 where it appears, -r1/1 where it goes, r1@3 for a message of it at 3 s."""
    found = []
    for cue in cues(messages):
        if isinstance(cue, Life):
            found.append(f"{'+' if cue.alive else '-'}{cue.node}/{cue.incarnation}")
        else:
            found.append(f"{cue.topic.split('/')[1]}@{cue.log_time_ns / SECOND:g}")
    return found


def test_a_life_is_there_from_its_first_message_to_its_last() -> None:
    messages = [said(0), said(1, "r2"), said(2), said(3, "r2"), said(3, "r2"), said(4)]
    assert shown(messages) == [
        *("+r1/1", "r1@0", "+r2/1", "r2@1", "r1@2", "r2@3", "r2@3", "-r2/1", "r1@4", "-r1/1")
    ]


def test_a_later_life_follows() -> None:
    messages = [said(0), said(1), said(2, incarnation=2), said(3, incarnation=2)]
    assert shown(messages) == ["+r1/1", "r1@0", "r1@1", "-r1/1", "+r1/2", "r1@2", "r1@3", "-r1/2"]


def test_who_is_silent_for_long_is_not_there_meanwhile() -> None:
    assert shown([said(0), said(4.9), said(11)]) == [
        *("+r1/1", "r1@0", "r1@4.9", "-r1/1", "+r1/1", "r1@11", "-r1/1")
    ]


def test_no_message_waits_longer_than_the_silence_is_long() -> None:
    taken: list[float] = []

    def source() -> Iterator[Recorded]:
        for at in range(100):
            taken.append(at)
            yield said(at)

    stream = cues(source())
    next(stream)
    assert next(stream) == said(0)
    assert taken[-1] == 6


def test_many_messages_at_one_time_take_only_so_much_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_AHEAD", 10)
    taken: list[int] = []

    def source() -> Iterator[Recorded]:
        for number in range(100):
            taken.append(number)
            yield said(0)

    stream = cues(source())
    next(stream)
    assert len(taken) == 11


@pytest.mark.parametrize(
    "message",
    [
        said(0, topic="hw/r2/drive"),
        said(0, incarnation=0),
        Recorded("hw/r1/drive", b"garbage", 0, 0, 0),
        said(0, topic="made/up"),
        said(0, "operator", topic="formation/goal"),
    ],
    ids=["somebody else's", "no life", "no header", "no topic", "anybody's"],
)
def test_only_who_alone_may_send_shows_itself(message: Recorded) -> None:
    assert list(cues([message])) == [message]


def test_the_last_of_each_latched_topic_in_their_order() -> None:
    messages = [
        said(0, topic="robot/r1/odometry"),
        said(1, topic="formation/goal"),
        said(2, topic="robot/r1/odometry"),
        said(3, topic="hw/r1/drive"),
    ]
    assert latched(messages) == (messages[1], messages[2])


def test_topics_that_are_latched_and_that_order() -> None:
    assert is_latched("faults/plan")
    assert not is_latched("hw/r1/drive")
    assert not is_latched("made/up")
    orders = ["robot/r1/command", "hw/r1/drive", "formation/goal", "platoon/stop", "faults/plan"]
    assert all(map(is_order, orders))
    assert not any(map(is_order, ["robot/r1/odometry", "journal/r1", "made/up"]))
