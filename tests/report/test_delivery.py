"""Shares over time, from hand-made journals."""

import numpy as np
import pytest

from maniple.core import topics
from maniple.core.envelope import Header
from maniple.core.messages import Call, Journal
from maniple.core.time import SECOND
from maniple.report.delivery import Delivery

BEGIN = 10**18


def one_link(robot: str, delivery: Delivery, lost: set[int]) -> None:
    """100 odometries, 0.1 s apart; some are lost."""
    topic = topics.odometry(robot)
    for seq in range(100):
        delivery.sent(topic, Header(robot, 1, seq, BEGIN + seq * SECOND // 10))
    calls = tuple(Call("message", 0, topic, robot, 1, seq) for seq in range(100) if seq not in lost)
    delivery.journal(Journal(source="controller", calls=calls))


def test_nothing_sent_no_shares() -> None:
    assert Delivery().shares(0) == ()


def test_a_message_counts_when_it_was_sent() -> None:
    delivery = Delivery()
    one_link("r1", delivery, set(range(40, 60)))
    one_link("r2", delivery, set(range(1, 100, 2)) - {99})
    (share,) = delivery.shares(BEGIN)
    assert (share.kind, share.links) == ("odometry", 2)
    assert share.t == pytest.approx([1.0, 3.0, 5.0, 7.0, 9.0])
    assert share.shares[0] == pytest.approx([1, 1, 0, 1, 1])
    assert share.shares[1] == pytest.approx([0.5, 0.5, 0.5, 0.5, 0.55])


def test_what_its_receiver_was_not_there_for_does_not_count() -> None:
    delivery = Delivery()
    one_link("r1", delivery, set(range(40)))
    (share,) = delivery.shares(BEGIN)
    assert share.t[0] == pytest.approx(5.0)
    assert np.nanmin(share.shares) == 1.0
