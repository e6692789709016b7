"""What operators said in a recording, moved into virtual time."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from maniple.core import codec
from maniple.core.envelope import envelope_of
from maniple.core.messages import Call, FaultPlan, FormationState, Goal, Journal, Message
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Fault
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.host.operators import Course, course_of
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter
from tests.host.nodes import scenario_with

START = 1_700_000_000 * SECOND
LATE = SECOND // 4

PLAN = FaultPlan(since_ns=START, source="router", incarnation=1, stamp_ns=START)
GOAL = Goal(id="here", hold=True, source="operator", incarnation=8, seq=2, stamp_ns=START + 7 * SECOND)
EDIT = FaultPlan(
    since_ns=START, faults=(Fault(loss=0.5),), source="operator", incarnation=9, stamp_ns=START + 9 * SECOND
)
STATE = FormationState(
    phase="running",
    task_time_s=1.0,
    task_duration_s=2.0,
    reference=(0.0, 0.0, 0.0),
    reference_velocity=(0.0, 0.0, 0.0),
    chain=(),
    errors=b"",
    roster=(),
    source="controller",
    incarnation=1,
    stamp_ns=START + 10 * SECOND,
)


def stop_of(node: str, now: int) -> Journal:
    return Journal(calls=(Call("stop", now),), source=node, incarnation=1, stamp_ns=now)


def course(folder: Path, said: dict[str, Message], mode: str = "realtime", **changes: Any) -> Course:
    scenario = scenario_with(**changes)
    path = folder / "a.mcap"
    with RecordingWriter(path, to_json(scenario), {"mode": mode}, prefix="maniple") as writer:
        for topic, message in said.items():
            message = replace(message, stamp_ns=max(message.stamp_ns, 1))
            name = topic.partition(" ")[0]
            writer.write(name, codec.encode(message), message.stamp_ns + LATE, message.stamp_ns, message.seq)
    return course_of(read(path))


def test_times_count_from_the_plan_that_the_run_began_with(tmp_path: Path) -> None:
    found = course(
        tmp_path,
        {
            "faults/plan": PLAN,
            "formation/goal": GOAL,
            "faults/plan edited": EDIT,
            "formation/goal again": GOAL,
            "formation/state": STATE,
            "journal/controller": stop_of("controller", START + 12 * SECOND),
            "journal/r1": stop_of("r1", START + 13 * SECOND),
        },
    )
    (goal_at, goal), (edit_at, edit) = found.inputs
    assert goal_at == VIRTUAL_EPOCH + 7 * SECOND + LATE
    assert codec.decode(goal.topic, goal.data) == replace(GOAL, stamp_ns=goal_at)
    assert edit_at == VIRTUAL_EPOCH + 9 * SECOND + LATE
    assert codec.decode(edit.topic, edit.data) == replace(EDIT, stamp_ns=edit_at, since_ns=VIRTUAL_EPOCH)
    assert (goal, edit) == tuple(envelope_of(one.topic, one.data) for one in (goal, edit))
    assert found.lasted == 12 * SECOND
    assert not found.done


def test_what_was_virtual_comes_back_byte_for_byte(tmp_path: Path) -> None:
    now = VIRTUAL_EPOCH + 3 * SECOND
    goal = replace(GOAL, stamp_ns=now)
    found = course(
        tmp_path, {"formation/goal": goal, "formation/state": replace(STATE, phase="done")}, "virtual"
    )
    assert found.inputs == ((now, envelope_of("formation/goal", codec.encode(goal))),)
    assert found.done


@pytest.mark.parametrize("node", ["controller", "r1"])
def test_the_end_is_told_by_a_clock_that_is_right(tmp_path: Path, node: str) -> None:
    other = "r1" if node == "controller" else "controller"
    found = course(
        tmp_path,
        {
            "faults/plan": PLAN,
            f"journal/{node}": stop_of(node, START + 20 * SECOND),
            f"journal/{other}": stop_of(other, START + 4 * SECOND),
        },
        clocks=[{"node": node, "offset_s": 16.0}],
    )
    assert found.lasted == 4 * SECOND


def test_without_a_last_word_the_end_is_what_was_heard_last(tmp_path: Path) -> None:
    late = stop_of("simulator", START + 11 * SECOND)
    found = course(tmp_path, {"faults/plan": PLAN, "formation/state": STATE, "journal/simulator": late})
    assert found.lasted == 10 * SECOND + LATE
    (tmp_path / "a.mcap").unlink()
    assert course(tmp_path, {"faults/plan": PLAN, "journal/simulator": late}).lasted == 11 * SECOND + LATE


def test_a_plan_from_before_the_run_stays_one_from_before(tmp_path: Path) -> None:
    old = replace(EDIT, since_ns=0)
    ((_, envelope),) = course(tmp_path, {"faults/plan": PLAN, "faults/plan edited": old}).inputs
    plan = codec.decode(envelope.topic, envelope.data)
    assert isinstance(plan, FaultPlan)
    assert plan.since_ns == 0


def test_plans_without_a_beginning_count_from_the_first_message(tmp_path: Path) -> None:
    ((at, _),) = course(
        tmp_path, {"formation/state": STATE, "formation/goal": replace(GOAL, stamp_ns=START + 15 * SECOND)}
    ).inputs
    assert at == VIRTUAL_EPOCH + 5 * SECOND
