"""The test of the emergency stop, on robots and a controller played by sessions."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from msgspec.structs import replace

from maniple.cli import stop_trial
from maniple.cli.operator import latched, operator_session, publish
from maniple.cli.stop_command import confirm
from maniple.cli.stop_trial import Watch, step_of, try_stop, trying
from maniple.core import codec, topics
from maniple.core.messages import Check, EmergencyStop, FormationState, RobotReport
from maniple.transport.zenoh import ZenohSession
from tests.cli.test_stop_command import Played, endpoint, saying
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

__all__ = ["endpoint"]


def state(*checks: Check, phase: str = "waiting", **head: Any) -> FormationState:
    return FormationState(
        phase=phase,  # type: ignore[arg-type]
        task_time_s=0.0,
        task_duration_s=1.0,
        reference=(0.0, 0.0, 0.0),
        reference_velocity=(0.0, 0.0, 0.0),
        chain=("r1", "r2"),
        errors=b"",
        roster=tuple(RobotReport(name, "present", 0.0, "waiting") for name in ("r1", "r2")),
        preflight=checks,
        **head,
    )


def checks(tested: bool | None = True, there: bool = True) -> tuple[Check, ...]:
    return tuple(
        Check(robot, item, holds, "" if holds else f"its {item} is missing")
        for robot in ("r1", "r2")
        for item, holds in (("there", there or robot == "r1"), ("stop tested", tested))
    )


@pytest.mark.parametrize(
    ("said", "step"),
    [
        (state(), "unasked"),
        (state(phase="running"), "begun"),
        (state(Check("r1", "stop tested", False, ""), phase="running"), "begun"),
        (state(*checks(there=False, tested=None)), "wait"),
        (state(*checks(there=False, tested=False)), "wait"),
        (state(*checks(tested=False)), "test"),
        (state(*checks(tested=False), phase="holding"), "test"),
        (state(*checks()), "passed"),
    ],
)
def test_what_is_to_be_done(said: FormationState, step: str) -> None:
    assert step_of(said) == step


@contextmanager
def obeying(*robots: Played) -> Iterator[None]:
    """Robots that do what the last operator said."""
    end = threading.Event()

    def say() -> None:
        while not end.wait(0.05):
            for robot in robots:
                stopped = bool(robot.heard) and robot.heard[-1].stopped
                robot.says("emergency" if stopped else "waiting")

    thread = threading.Thread(target=say)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def test_everybody_stands_and_is_armed_again_in_one_life_of_the_operator(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    with (
        one.session,
        two.session,
        obeying(one, two),
        operator_session(endpoint, "maniple", DEADLINE_S) as session,
    ):
        found = try_stop(session)
        kept = latched(session, topics.STOP)
    assert found.ok, found
    assert found.why.startswith("tested: 2 robots stood after ")
    assert found.stop is not None
    assert found.arm is not None
    assert (found.stop.stopped, found.arm.stopped) == (True, False)
    said = [message.stopped for message in one.heard]
    assert said == sorted(said, reverse=True)
    assert len({message.incarnation for message in one.heard}) == 1
    assert [message.seq for message in one.heard] == list(range(len(one.heard)))
    assert isinstance(kept, EmergencyStop)
    assert (kept.stopped, kept.reason) == (False, "pre-flight check")


def test_somebody_elses_stop_is_left_alone(endpoint: str) -> None:
    one = Played(endpoint, "r1")
    with one.session, obeying(one), operator_session(endpoint, "maniple", DEADLINE_S) as session:
        publish(session, topics.STOP, EmergencyStop(stopped=True, reason="a dog"), DEADLINE_S)
        found = try_stop(session)
        kept = latched(session, topics.STOP)
    assert (found.ok, found.stop) == (False, None)
    assert found.why == "not tested: an emergency stop stands (a dog); maniple arm releases it"
    assert isinstance(kept, EmergencyStop)
    assert (kept.stopped, kept.reason) == (True, "a dog")


def test_a_stop_that_comes_meanwhile_stays(endpoint: str) -> None:
    """The release belongs to the life of the test's own stop, so what came after that is above it."""
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    with (
        one.session,
        two.session,
        saying(one, 1, "emergency"),
        saying(two, 99, "emergency"),
        operator_session(endpoint, "maniple", DEADLINE_S) as session,
    ):
        other = EmergencyStop(stopped=True, reason="a dog", source="operator", incarnation=2**61)
        late = threading.Timer(0.3, lambda: one.session.put(topics.STOP, codec.encode(other)))
        late.start()
        found = try_stop(session, 1.0)
        late.join()
        kept = latched(session, topics.STOP)
    assert (found.ok, found.arm) == (False, None)
    assert found.why == "not tested: another operator has said something meanwhile"
    assert isinstance(kept, EmergencyStop)
    assert kept.reason == "a dog"


@pytest.mark.parametrize("when", [True, False])
def test_a_stop_that_was_under_way_as_the_test_began_stays(
    endpoint: str, when: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is of an earlier life than the test's own. It arrives while robots stand, or as they are armed."""
    one = Played(endpoint, "r1")
    with one.session, obeying(one), operator_session(endpoint, "maniple", DEADLINE_S) as session:
        publish(session, topics.STOP, EmergencyStop(stopped=False), DEADLINE_S)
        other = EmergencyStop(stopped=True, reason="a dog", source="operator", incarnation=1)
        heard: list[EmergencyStop] = []

        def confirmed(*arguments: Any, **options: Any) -> Any:
            found = confirm(*arguments, **options)
            if found.stopped == when and not heard:
                heard.append(other)
                one.session.put(topics.STOP, codec.encode(other))
                one.session.settle()
                session.settle()
            return found

        monkeypatch.setattr(stop_trial, "confirm", confirmed)
        found = try_stop(session)
        kept = latched(session, topics.STOP)
    assert (found.ok, found.arm is None) == (False, when)
    assert found.why == "not tested: another operator has said something meanwhile"
    assert isinstance(kept, EmergencyStop)
    assert kept.stopped


def test_a_robot_that_goes_on_fails_the_test_and_is_named(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    with (
        one.session,
        two.session,
        obeying(one),
        saying(two, 99, "emergency"),
        operator_session(endpoint, "maniple", DEADLINE_S) as session,
    ):
        found = try_stop(session, 0.6)
        kept = latched(session, topics.STOP)
    assert not found.ok
    assert "r2 does not confirm: it is tracking" in found.why
    assert isinstance(kept, EmergencyStop)
    assert not kept.stopped, "it is released again: nobody moves before it has passed"


class Spoken:
    """A controller that says what it is told to, at its rate."""

    def __init__(self, endpoint: str, says: Callable[[], FormationState]) -> None:
        self._session = ZenohSession.client(endpoint, "maniple")
        self._says = says
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> "Spoken":
        self._session.announce("controller", 1)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._session.close()

    def _work(self) -> None:
        seq = 0
        while not self._end.wait(0.05):
            said = self._says()
            sent = replace(said, source="controller", incarnation=1, seq=seq, stamp_ns=seq)
            self._session.put(topics.FORMATION_STATE, codec.encode(sent))
            seq += 1


def test_the_newest_word_counts(endpoint: str) -> None:
    with operator_session(endpoint, "maniple", DEADLINE_S) as session:
        watch = Watch(session)
        assert watch.newest(0.0) is None
        with Spoken(endpoint, state):
            assert watch.newest(DEADLINE_S) is not None


def test_a_run_tests_it_by_itself_once_everything_else_holds(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    there, notices = threading.Event(), list[str]()

    def says() -> FormationState:
        tested = any(not message.stopped for message in one.heard)
        if tested:
            return state(phase="running")
        return state(*checks(tested=False, there=there.is_set()))

    with (
        one.session,
        two.session,
        obeying(one, two),
        Spoken(endpoint, says),
        trying(endpoint, "maniple", notices.append),
        operator_session(endpoint, "maniple", DEADLINE_S) as session,
    ):
        assert Watch(session).newest(DEADLINE_S) is not None
        assert not one.heard, "r2 is not there yet"
        there.set()
        eventually(lambda: bool(notices))
    (notice,) = notices
    assert notice.startswith("emergency stop tested: 2 robots stood after ")


def test_a_run_says_where_it_could_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_trial, "CONFIRM_S", 0.3)
    notices: list[str] = []
    with trying(f"tcp/127.0.0.1:{free_port()}", "maniple", notices.append):
        eventually(lambda: bool(notices))
    assert "emergency stop not tested: " in notices[0]
