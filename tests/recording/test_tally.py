import json
import random

import pytest

from maniple.recording.tally import Gap, Stream, Tally


def one(tally: Tally) -> Stream:
    [stream] = tally.streams()
    return stream


def noted(*seqs: int) -> Tally:
    tally = Tally()
    for seq in seqs:
        tally.note("hw/r1/drive", "r1", 1, seq)
    return tally


@pytest.mark.parametrize(
    ("seqs", "gaps", "sent", "missed_first", "repeated"),
    [
        ([0, 1, 2], [], 3, 0, 0),
        ([0, 1, 4, 5, 7], [(2, 3), (6, 6)], 8, 0, 0),
        ([3, 4], [(0, 2)], 5, 3, 0),
        ([0, 1, 1, 2, 0], [], 3, 0, 2),
        ([0, 5, 2], [(1, 1), (3, 4)], 6, 0, 0),
        ([0, 3, 1, 2], [], 4, 0, 0),
        ([2, 0], [(1, 1)], 3, 0, 0),
        ([4, 2, 2, 6], [(0, 1), (3, 3), (5, 5)], 7, 2, 1),
    ],
)
def test_gaps(
    seqs: list[int], gaps: list[tuple[int, int]], sent: int, missed_first: int, repeated: int
) -> None:
    stream = one(noted(*seqs))
    assert stream.gaps == tuple(Gap(first, last) for first, last in gaps)
    assert (stream.sent, stream.recorded) == (sent, len(set(seqs)))
    assert stream.missing == sent - len(set(seqs))
    assert (stream.missed_first, stream.missed_last, stream.repeated) == (missed_first, 0, repeated)


def test_any_order_against_a_set() -> None:
    rng = random.Random(4)
    for _ in range(200):
        seqs = [rng.randrange(30) for _ in range(rng.randrange(1, 40))]
        stream = one(noted(*seqs))
        found = {seq for gap in stream.gaps for seq in range(gap.first, gap.last + 1)}
        assert found == set(range(max(seqs))) - set(seqs)
        assert stream.missing == len(found)
        assert stream.recorded == len(set(seqs))
        assert stream.repeated == len(seqs) - len(set(seqs))


def test_what_was_lost_at_the_end_is_told_by_the_sender() -> None:
    tally = noted(0, 1, 3)
    tally.told("r1", 1, {"hw/r1/drive": 3})
    assert one(tally).missed_last == 0
    tally.told("r1", 1, {"hw/r1/drive": 7})
    tally.told("r1", 1, {"hw/r1/drive": 5})
    stream = one(tally)
    assert (stream.sent, stream.missed_last) == (7, 3)
    assert stream.gaps == (Gap(2, 2), Gap(4, 6))


def test_a_topic_of_which_nothing_came() -> None:
    tally = Tally()
    tally.told("r1", 2, {"hw/r1/drive": 4})
    stream = one(tally)
    assert (stream.incarnation, stream.sent, stream.recorded, stream.missing) == (2, 4, 0, 4)
    assert (stream.missed_first, stream.missed_last) == (0, 4)


def test_each_life_of_each_sender_counts_for_itself() -> None:
    tally = Tally()
    for topic, source, life, seq in [("a", "x", 1, 1), ("a", "x", 2, 0), ("a", "y", 1, 0), ("b", "x", 1, 2)]:
        tally.note(topic, source, life, seq)
    assert [(s.topic, s.source, s.incarnation, s.missing) for s in tally.streams()] == [
        ("a", "x", 1, 1),
        ("a", "x", 2, 0),
        ("a", "y", 1, 0),
        ("b", "x", 1, 2),
    ]


def test_as_metadata() -> None:
    tally = noted(2, 3, 5)
    tally.note("a", "x", 1, 0)
    told = tally.to_metadata()
    assert (told["sent"], told["recorded"], told["missing"]) == ("7", "4", "3")
    assert json.loads(told["hw/r1/drive r1 1"]) == {
        "sent": 6,
        "recorded": 3,
        "missing": 3,
        "missed_first": 2,
        "missed_last": 0,
        "repeated": 0,
        "gaps": [[0, 1], [4, 4]],
    }
    many = json.loads(noted(*range(0, 1000, 2)).to_metadata()["hw/r1/drive r1 1"])
    assert (len(many["gaps"]), many["more_gaps"]) == (100, 399)


def test_forged_names_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniple.recording.tally.MOST_STREAMS", 3)
    tally = Tally()
    for life in range(5):
        tally.note("a", "x", life, 0)
        tally.told("y", life, {"a": 1})
    assert len(tally.streams()) == 3
    assert tally.untold == 3
