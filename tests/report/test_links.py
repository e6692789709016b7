"""What became of messages, from hand-made journals and decisions."""

from collections.abc import Iterable

from maniple.core import codec, topics
from maniple.core.messages import Call, Cause, Decided, Decisions, Journal, Refused
from maniple.report.links import LinkCounts, LinkTotals

ODOMETRY = topics.odometry("r1")


def journal(*calls: Call, source: str = "controller") -> Journal:
    return Journal(source=source, incarnation=1, calls=calls)


def accepted(seq: int, topic: str = ODOMETRY, source: str = "r1", incarnation: int = 1) -> Call:
    return Call("message", 0, topic, source, incarnation, seq)


def refused(topic: str = ODOMETRY, sender: str = "r1", reason: str = "old", count: int = 1) -> Call:
    data = codec.encode(Refused(source="host", topic=topic, sender=sender, reason=reason, count=count))
    return Call("message", 0, topics.HOST_REFUSED, "host", 1, 0, 0, data)


def decided(seqs: Iterable[int], dropped: Iterable[int] = ()) -> Decisions:
    lost = set(dropped)
    return Decisions(
        source="controller", decided=tuple(Decided("r1", ODOMETRY, 1, seq, seq in lost, 0) for seq in seqs)
    )


def totals(*messages: Journal | Decisions) -> tuple[int, int, int, int, int]:
    counts = LinkCounts()
    for message in messages:
        if isinstance(message, Journal):
            counts.journal(message)
        else:
            counts.decisions(message)
    found = counts.totals()
    assert list(found) == ["sent", "delivered", "lost_injected", "lost_other", "refused"]
    sent, delivered, injected, other, refusals = found.values()
    return sent, delivered, injected, other, refusals


def test_nothing_said_nothing_counted() -> None:
    assert totals() == (0, 0, 0, 0, 0)
    assert totals(journal(Call("start", 0), Call("timer", 1, "control"))) == (0, 0, 0, 0, 0)


def test_all_that_arrives_is_delivered() -> None:
    assert totals(journal(*map(accepted, range(5, 9)))) == (4, 4, 0, 0, 0)


def test_a_gap_is_a_loss_that_nobody_injected() -> None:
    assert totals(journal(*map(accepted, (3, 4, 7, 9)))) == (7, 4, 0, 3, 0)


def test_order_does_not_matter() -> None:
    pieces: list[Journal | Decisions] = [
        journal(accepted(7)),
        decided(range(3, 10), (4,)),
        journal(accepted(3), accepted(5)),
    ]
    assert totals(*pieces) == totals(*pieces[::-1])


def test_drops_are_injected_losses() -> None:
    calls = journal(*map(accepted, (0, 1, 3, 5)))
    assert totals(decided(range(6), (2, 4)), calls) == (6, 4, 2, 0, 0)


def test_what_was_never_decided_did_not_arrive() -> None:
    """Of 0 .. 5 the receiver saw all but 3; it dropped 2 and 4."""
    calls = journal(*map(accepted, (0, 1, 5)))
    assert totals(decided((0, 1, 2, 4, 5), (2, 4)), calls) == (6, 3, 2, 1, 0)


def test_what_is_still_held_back_is_sent_and_not_lost() -> None:
    assert totals(decided(range(6)), journal(*map(accepted, range(4)))) == (6, 4, 0, 0, 0)


def test_the_last_may_be_dropped() -> None:
    assert totals(decided(range(3), (0, 2)), journal(accepted(1))) == (3, 1, 2, 0, 0)


def test_a_refused_message_is_no_loss() -> None:
    """0, 2, 1 arrive in this order: 1 is old."""
    assert totals(journal(accepted(0), accepted(2), refused())) == (3, 2, 0, 0, 1)
    assert totals(decided(range(3)), journal(accepted(0), accepted(2), refused())) == (3, 2, 0, 0, 1)


def test_a_refusal_is_of_its_link_alone() -> None:
    other = topics.odometry("r2")
    calls = journal(*map(accepted, (0, 2)), *(accepted(seq, other, "r2") for seq in (0, 2)), refused())
    assert totals(calls) == (6, 4, 0, 1, 1)
    elsewhere = journal(refused(), source="r3")
    assert totals(journal(*map(accepted, (0, 2))), elsewhere) == (3, 2, 0, 1, 1)


def test_every_receiver_and_every_life_is_a_link_of_its_own() -> None:
    status = topics.status("r1")
    two = [journal(*(accepted(seq, status) for seq in (0, 1, 3)), source=name) for name in ("r2", "r3")]
    assert totals(*two) == (8, 6, 0, 2, 0)
    lives = journal(*map(accepted, (8, 9)), *(accepted(seq, incarnation=2) for seq in (0, 1)))
    assert totals(lives) == (4, 4, 0, 0, 0)


def test_what_a_node_said_in_an_earlier_life_came_over_no_link() -> None:
    assert totals(journal(accepted(0, topics.FORMATION_STATE, "controller"))) == (0, 0, 0, 0, 0)


def test_only_links_that_faults_apply_to_count() -> None:
    calls = journal(
        accepted(0, topics.motion("r1"), "simulator"),
        accepted(5, topics.motion("r1"), "simulator"),
        accepted(0, topics.HOST_ALIVE, "host"),
        refused(topics.motion("r1"), "simulator"),
        refused("unheard/of", "r9"),
        refused("", ""),
        source="r1",
    )
    assert totals(calls) == (0, 0, 0, 0, 0)


def test_a_refusal_that_can_not_be_read_is_passed_over() -> None:
    broken = Call("message", 0, topics.HOST_REFUSED, "host", 1, 0, 0, b"\xc1")
    missing = Call("message", 0, topics.HOST_REFUSED, "host", 1, 0, 0, None)
    assert totals(journal(broken, missing, accepted(0))) == (1, 1, 0, 0, 0)


def test_a_topic_of_another_version_is_passed_over() -> None:
    assert totals(journal(accepted(0, "robot/r1/mood"), accepted(0))) == (1, 1, 0, 0, 0)


def test_what_a_dead_receiver_was_sent_is_lost() -> None:
    """2 and 3 were let pass and never taken in; 4 was, by the next life of the receiver."""
    calls = journal(*map(accepted, (0, 1, 4)))
    assert totals(decided(range(6)), calls) == (6, 3, 0, 2, 0)


def test_what_is_due_after_the_end_is_held_back_though_a_later_one_was_faster() -> None:
    def at_the_end(due_ns: int) -> tuple[int, ...]:
        slow = Decided("r1", ODOMETRY, 1, 2, False, due_ns - 100)
        calls = (*map(accepted, (0, 1)), Call("message", 200, ODOMETRY, "r1", 1, 3))
        passed = decided((0, 1, 3))
        late = Decisions(source="controller", stamp_ns=100, decided=(slow,))
        return totals(passed, late, journal(*calls))

    assert at_the_end(201) == (4, 3, 0, 0, 0)
    assert at_the_end(200) == (4, 3, 0, 1, 0)


def test_a_second_copy_is_no_message_of_its_own() -> None:
    """Of 0 .. 4, 1 comes twice and 3 not at all; of the copies of 4 the second is still on its way."""
    copied = tuple(
        Decided("r1", ODOMETRY, 1, seq, False, 0, copy_delay_ns=due) for seq, due in ((1, 5), (4, 999))
    )
    plan = Decisions(source="controller", decided=copied)
    calls = (Call("message", 200, ODOMETRY, "r1", 1, seq) for seq in (0, 1, 2, 4))
    assert totals(plan, journal(*calls, refused())) == (5, 4, 0, 1, 0)


def test_what_was_corrupted_is_refused_and_not_lost_besides() -> None:
    """1 and 3 are corrupted, 3 is still on its way; both copies of 2 are."""
    spoilt = tuple(
        Decided("r1", ODOMETRY, 1, seq, False, delay, True, copy)
        for seq, delay, copy in ((1, 0, -1), (2, 0, 3), (3, 999, -1))
    )
    calls = (Call("message", 200, ODOMETRY, "r1", 1, seq) for seq in (0, 4))
    refusals = (refused(reason="corrupted"), refused(reason="corrupted", count=2))
    assert totals(Decisions(source="controller", decided=spoilt), journal(*calls, *refusals)) == (
        5,
        2,
        0,
        0,
        2,
    )


def test_injected_losses_are_told_by_cause() -> None:
    counts = LinkCounts()
    causes: tuple[Cause, ...] = ("cut", "cut", "loss", "burst", "rate", "cut")
    dropped = tuple(Decided("r1", ODOMETRY, 1, seq, True, 0, cause=cause) for seq, cause in enumerate(causes))
    counts.decisions(Decisions(source="controller", decided=dropped))
    assert counts.links()[0].causes == (("cut", 3), ("loss", 1), ("burst", 1), ("rate", 1))


def test_every_link_by_itself_over_all_lives() -> None:
    counts = LinkCounts()
    counts.journal(journal(*map(accepted, (0, 1, 3)), *(accepted(seq, incarnation=2) for seq in (0, 1))))
    counts.journal(journal(accepted(4, topics.command("r1"), "controller"), source="r1"))
    counts.decisions(decided(range(6), (2, 4)))
    assert counts.links() == [
        LinkTotals("controller", "r1", topics.command("r1"), 1, 1, 0, 0, 0),
        LinkTotals("r1", "controller", ODOMETRY, 8, 5, 2, 0, 0, (("loss", 2),)),
    ]
    assert counts.spans()["controller", "r1", ODOMETRY, 1] == (0, 5)
