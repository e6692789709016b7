from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal, RobotReport
from maniple.core.plans import BLANK
from maniple.core.scenario.types import Crash, Fault, Formation, Freeze, Line, Partition
from maniple.core.time import SECOND
from maniple.report.timeline import Span, events_of, injected_of, spans_of
from tests.core.test_happenings import state as state_of


def spans(*said: tuple[float, str], end: float = 10.0, silent: float = 3.0) -> list[Span]:
    rows = [(round(t * SECOND), what) for t, what in said]
    return list(spans_of(rows, 0, end, silent))


def test_what_is_said_again_goes_on() -> None:
    assert spans((0, "a"), (1, "a"), (2, "b"), (3, "b"), end=4) == [(0, 2, "a"), (2, 4, "b")]


def test_silence_ends_a_span() -> None:
    assert spans((0, "a"), (1, "a"), (8, "a"), end=9) == [(0, 4, "a"), (8, 9, "a")]
    assert spans((0, "a"), end=10) == [(0, 3, "a")]


def test_nothing_said_is_no_span() -> None:
    assert spans((0, ""), (1, "a"), (2, ""), (3, "")) == [(1, 2, "a")]
    assert spans() == []


def state(t_s: float, **changes: object) -> FormationState:
    return state_of(stamp_ns=round(t_s * SECOND), **changes)


def test_changes_are_events() -> None:
    there, gone = RobotReport("r4", "present", 0.0, "tracking"), RobotReport("r4", "lost", 9.0, "")
    states = [
        state(0, phase="waiting", roster=(RobotReport("r4", "absent", -1.0, ""),)),
        state(1, roster=(there,)),
        state(2, roster=(there,)),
        state(3, roster=(gone,), chain=("r1", "r3", "r2")),
        state(4, roster=(gone,), phase="holding", reason="told to", chain=("r1", "r3", "r2")),
        state(5, phase="holding", reason="too few", chain=(), incarnation=2),
        state(6, incarnation=2, goal="x", goal_refused="too fast", leg=1, supervisor=("opens r1 r2 r3",)),
        state(7, incarnation=2, goal="y", leg=1, supervisor=("opens r1 r2 r3",)),
    ]
    goals = [
        Goal(id="x", stamp_ns=round(5.5 * SECOND), hold=False, formation=Formation()),
        Goal(id="y", stamp_ns=round(6.5 * SECOND), task=Line(start=(0, 0), end=(1, 0), speed_mps=0.1)),
    ]
    events = events_of(states, goals, [(2.5, "r1|obstacle 0")], 0)
    assert [(event.t, event.what) for event in events] == [
        (0.0, "waiting"),
        (1.0, "running"),
        (2.5, "contact: r1 and obstacle 0"),
        (3.0, "chain r1 r3 r2"),
        (3.0, "r4 lost"),
        (4.0, "holding: told to"),
        (5.0, "too few"),
        (5.0, "the controller lives anew"),
        (5.0, "chain of nobody"),
        (5.5, "goal: another shape, resume"),
        (6.0, "running"),
        (6.0, "part 2 of the task"),
        (6.0, "chain r1 r2 r3"),
        (6.0, "goal refused: too fast"),
        (6.0, "supervisor: opens r1 r2 r3"),
        (6.5, "goal: task line"),
        (7.0, "goal accepted"),
    ]


def at(t_s: float) -> int:
    return round(t_s * SECOND)


def told(*plans: FaultPlan, end_s: float = 100) -> list[tuple[float, str]]:
    return [(event.t, event.what) for event in events_of([], [], [], at(5), (), plans, at(5 + end_s))]


def test_of_a_wait_it_is_told_why_it_began() -> None:
    states = [
        state(0),
        state(1, waits_for=("r3",), reason="waits for r3: it is not there"),
        state(2, waits_for=("r1", "r3"), reason="waits for r1, r3: they are not there"),
        state(3),
        state(4, waits_for=("r1",), reason="waits for r1: old"),
    ]
    events = events_of(states, [], [], 0)
    assert [(event.t, event.what) for event in events] == [
        (0.0, "running"),
        (1.0, "waits for r3: it is not there"),
        (4.0, "waits for r1: old"),
    ]


def test_faults_begin_when_they_are_planned() -> None:
    plan = FaultPlan(
        since_ns=at(5),
        faults=(Fault(source="r3", loss=0.1, windows=((10, 20), (30, 35))), Fault(latency_s=0.1), BLANK),
        partitions=(Partition(groups=(("r1", "r2"), ("r3",)), at_s=40, for_s=4),),
        crashes=(
            Crash(node="controller", at_s=50, restart_after_s=3),
            Crash(node="r4", at_s=60),
            Crash(node="r5", at_s=200),
        ),
        freezes=(Freeze(node="r2", at_s=55, for_s=2),),
    )
    assert told(plan) == [
        (0.0, "fault rule 1, from * to *, topic *"),
        (10.0, "fault rule 0, from r3 to *, topic *, for 10 s"),
        (30.0, "fault rule 0, from r3 to *, topic *, for 5 s"),
        (40.0, "partition r1,r2 | r3 | all others for 4 s"),
        (50.0, "controller is killed, back after 3 s"),
        (55.0, "r2 is frozen for 2 s"),
        (60.0, "r4 is killed"),
    ]


def test_a_changed_plan_takes_back_what_has_not_begun() -> None:
    rule, crash = Fault(loss=0.1), Crash(node="r4", at_s=30)
    plans = [
        FaultPlan(since_ns=at(5), stamp_ns=at(5), crashes=(crash,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(15), faults=(rule,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(16), faults=(rule,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(20), faults=()),
        FaultPlan(since_ns=at(5), stamp_ns=at(45), faults=(rule,), crashes=(crash,)),
    ]
    what = "fault rule 0, from * to *, topic *"
    assert told(*plans) == [(10.0, what), (40.0, what), (40.0, "r4 is killed")]


def test_an_emergency_stop_is_told_once() -> None:
    stops = [
        EmergencyStop(stopped=True, reason="x", source="operator", incarnation=7, seq=seq, stamp_ns=at(2))
        for seq in range(2)
    ]
    stops.append(EmergencyStop(stopped=False, source="operator", incarnation=8, stamp_ns=at(4)))
    events = events_of([], [], [], at(1), stops)
    assert events == ((1.0, "emergency stop: x"), (3.0, "armed"))


def on(*plans: FaultPlan, end_s: float = 100) -> list[tuple[object, ...]]:
    return [tuple(one) for one in injected_of(plans, at(5), at(5 + end_s))]


def test_faults_last_as_long_as_they_are_planned() -> None:
    plan = FaultPlan(
        since_ns=at(5),
        faults=(Fault(source="r3", loss=0.1, windows=((10, 20), (30, 135))), Fault(latency_s=0.1)),
        partitions=(Partition(groups=(("r1", "r2"), ("r3",)), at_s=40, for_s=4),),
        crashes=(
            Crash(node="controller", at_s=50, restart_after_s=3),
            Crash(node="r4", at_s=60),
            Crash(node="r5", at_s=200),
        ),
        freezes=(Freeze(node="r2", at_s=55, for_s=2),),
    )
    assert on(plan) == [
        (0.0, 100.0, "links", "* to *"),
        (10.0, 20.0, "links", "r3 to *"),
        (30.0, 100.0, "links", "r3 to *"),
        (40.0, 44.0, "partition", "r1,r2 | r3"),
        (50.0, 53.0, "killed", "controller"),
        (55.0, 57.0, "frozen", "r2"),
        (60.0, 100.0, "killed", "r4"),
    ]


def test_rules_end_with_their_plan_and_the_dead_stay_dead() -> None:
    rule = Fault(source="r1", loss=0.1)
    parted = Partition(groups=(("r1",),), at_s=5)
    crash = Crash(node="r4", at_s=6, restart_after_s=20)
    plans = [
        FaultPlan(since_ns=at(5), stamp_ns=at(5), faults=(rule,), partitions=(parted,), crashes=(crash,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(12), faults=(rule,), partitions=(parted,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(15), partitions=(parted,)),
        FaultPlan(since_ns=at(5), stamp_ns=at(20)),
        FaultPlan(since_ns=at(5), stamp_ns=at(35), faults=(rule,)),
    ]
    assert on(*plans) == [
        (0.0, 10.0, "links", "r1 to *"),
        (5.0, 15.0, "partition", "r1"),
        (6.0, 26.0, "killed", "r4"),
        (30.0, 100.0, "links", "r1 to *"),
    ]


def test_what_is_planned_for_before_the_recording_begins_there() -> None:
    """It was started late, or its clock says so."""
    plan = FaultPlan(since_ns=at(1), stamp_ns=at(1), faults=(Fault(loss=0.1, windows=((0, 10), (1, 2))),))
    assert on(plan) == [(0.0, 6.0, "links", "* to *")]
