from maniple.core.happenings import Happening, changes, contact, planned, stop, wish
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal, RobotReport
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition


def state(**changes: object) -> FormationState:
    values = {
        "incarnation": 1,
        "phase": "running",
        "task_time_s": 0.0,
        "task_duration_s": 1.0,
        "reference": (0.0, 0.0, 0.0),
        "reference_velocity": (0.0, 0.0, 0.0),
        "chain": ("r1", "r2", "r3"),
        "errors": b"",
        "roster": (),
    }
    return FormationState(**(values | changes))  # type: ignore[arg-type]


def test_the_first_state_tells_its_phase() -> None:
    assert list(changes(None, state())) == [("running", "info")]
    assert list(changes(None, state(phase="holding", reason="told to"))) == [("holding: told to", "warning")]


def test_nothing_new_is_nothing() -> None:
    assert list(changes(state(), state())) == []


def test_a_wait_is_told_when_it_begins() -> None:
    waits = state(reason="waits for r1: it is not heard", waits_for=("r1",))
    both = state(reason="waits for r1, r2: they are not heard", waits_for=("r1", "r2"))
    assert list(changes(state(), waits)) == [(waits.reason, "warning")]
    assert list(changes(waits, both)) == []


def test_what_matters_has_weight() -> None:
    before = state(roster=(RobotReport("r1", "present", 0.0, "tracking"),))
    after = state(
        incarnation=2,
        chain=("r2", "r3", "r4"),
        leg=1,
        goal="a",
        goal_refused="too fast",
        roster=(RobotReport("r1", "lost", 0.0, ""),),
        supervisor=("leads r2",),
    )
    assert list(changes(before, after)) == [
        ("the controller lives anew", "warning"),
        ("part 2 of the task", "info"),
        ("chain r2 r3 r4", "info"),
        ("goal refused: too fast", "warning"),
        ("r1 lost", "error"),
        ("supervisor: leads r2", "info"),
    ]


def test_operators() -> None:
    assert wish(Goal(id="a", hold=True)) == Happening("goal: hold")
    assert wish(Goal(id="a")) == Happening("goal: nothing")
    assert stop(EmergencyStop(stopped=True, reason="smoke")) == ("emergency stop: smoke", "error")
    assert stop(EmergencyStop(stopped=False)) == ("armed", "info")


def test_contacts() -> None:
    assert contact("r1|obstacle 3") == ("contact: r1 and obstacle 3", "error")


def test_a_plan_part_by_part() -> None:
    plan = FaultPlan(
        since_ns=0,
        faults=(Fault(loss=0.1, windows=((1.0, 3.0), (5.0, 6.0))), Fault(source="r1", loss=0.1)),
        partitions=(Partition(groups=(("r1", "r2"),), at_s=2.0, for_s=4.0),),
        crashes=(Crash(node="r3", at_s=7.0), Crash(node="r2", at_s=8.0, restart_after_s=1.5)),
        freezes=(Freeze(node="r1", at_s=9.0, for_s=0.5),),
    )
    assert list(planned(plan)) == [
        (1.0, "fault rule 0, from * to *, topic *, for 2 s"),
        (5.0, "fault rule 0, from * to *, topic *, for 1 s"),
        (0.0, "fault rule 1, from r1 to *, topic *"),
        (2.0, "partition r1,r2 | all others for 4 s"),
        (7.0, "r3 is killed"),
        (8.0, "r2 is killed, back after 1.5 s"),
        (9.0, "r1 is frozen for 0.5 s"),
    ]
