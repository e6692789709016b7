"""What is taken in: whole, from its sender, of a life that showed itself, newer, and not far ahead."""

from dataclasses import dataclass

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.messages import Command, Goal, Message, Motion
from maniple.core.scenario.types import Rates
from maniple.core.time import SECOND, Duration
from maniple.host.inlets import MOST_OPERATORS, Inlets
from tests.host.nodes import command

COMMAND = topics.command("r1")


def envelope(
    seq: int,
    incarnation: int = 1,
    source: str = "controller",
    topic: str = COMMAND,
    message: Message | None = None,
) -> Envelope:
    stamped = msgspec.structs.replace(
        message or command(), source=source, seq=seq, incarnation=incarnation, stamp_ns=0
    )
    return envelope_of(topic, codec.encode(stamped))


@dataclass
class Judge:
    inlets: Inlets
    now: Duration = 0

    def __call__(self, *arguments: int, latched: bool = False, **options: str) -> str:
        judged = self.inlets.judge(envelope(*arguments, **options), self.now, latched)  # type: ignore[arg-type]
        return judged if isinstance(judged, str) else "taken"


@pytest.fixture
def judge() -> Judge:
    inlets = Inlets(Rates(control_hz=10))
    inlets.announced("controller", 1)
    return Judge(inlets)


def test_what_is_newer_is_taken_and_what_is_not_is_old(judge: Judge) -> None:
    assert [judge(seq) for seq in (4, 5, 5, 3, 9)] == ["taken", "taken", "old", "old", "taken"]


def test_a_life_that_never_showed_itself_is_not_believed(judge: Judge) -> None:
    assert judge(0) == "taken"
    assert judge(0, 2**61) == "unannounced"
    assert judge(1) == "taken", "and the one that lives is not locked out"
    judge.inlets.announced("controller", 2)
    assert judge(0, 2) == "taken"
    assert judge(2, 1) == "old"


def test_what_the_router_kept_may_be_of_a_life_that_is_over(judge: Judge) -> None:
    assert judge(7, 5, latched=True) == "taken"


def test_a_forged_number_far_ahead_does_not_lock_its_sender_out(judge: Judge) -> None:
    assert judge(0) == "taken"
    judge.now += SECOND // 10
    assert judge(2**61) == "leap"
    assert judge(1) == "taken"


@pytest.mark.parametrize("silent_s", [1, 5, 60])
def test_after_a_silence_what_was_sent_in_it_may_be_missing(judge: Judge, silent_s: int) -> None:
    judge(0)
    judge.now += silent_s * SECOND
    assert judge(10 * silent_s) == "taken"


def test_how_far_ahead_follows_the_rates_of_the_scenario() -> None:
    for rate_hz, verdict in ((10.0, "leap"), (1000.0, "taken")):
        inlets = Inlets(Rates(control_hz=rate_hz))
        inlets.announced("controller", 1)
        judge = Judge(inlets)
        judge(0)
        assert judge(500) == verdict


def test_what_is_corrupted_on_the_way_is_refused_even_if_it_can_be_read(judge: Judge) -> None:
    good = envelope(0)
    data = bytearray(good.data)
    data[-1] ^= 1
    bad = msgspec.structs.replace(good, data=bytes(data), altered=True)
    assert judge.inlets.judge(bad, 0) == "corrupted"
    taken = judge.inlets.judge(good, 0)
    assert isinstance(taken, Command)


def test_a_foreign_sender_is_refused_and_not_remembered(judge: Judge) -> None:
    for k in range(1000):
        assert judge(0, 1, source=f"forged{k}") == "sender"
    assert not judge.inlets.report()


def test_only_so_many_operators_are_heard(judge: Judge) -> None:
    verdicts = [
        judge.inlets.judge(envelope(0, 7, f"operator{k}", topics.FORMATION_GOAL, Goal(id="g")), 0)
        for k in range(MOST_OPERATORS + 5)
    ]
    assert sum(isinstance(verdict, Goal) for verdict in verdicts) == MOST_OPERATORS
    assert verdicts[-5:] == ["sender"] * 5


def test_the_hardware_network_needs_no_tokens(judge: Judge) -> None:
    motion = Motion(ticks=(0, 0), applied=(0.0, 0.0), state="active", controllable=True)
    verdict = judge.inlets.judge(envelope(0, 3, "simulator", topics.motion("r1"), motion), 0)
    assert isinstance(verdict, Motion)
