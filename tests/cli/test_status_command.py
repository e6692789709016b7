"""How a running platoon is, as a value, as a table and as a command."""

import json
import signal
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from maniple.cli import fault_text
from maniple.cli.operator import Known
from maniple.cli.platoon_state import PlatoonState, RecorderState, state_of
from maniple.cli.program import app
from maniple.cli.status_text import pairs, picture
from maniple.core import codec, topics
from maniple.core.errors import RunError
from maniple.core.messages import (
    Check,
    EmergencyStop,
    FaultPlan,
    FormationState,
    LinkReport,
    LinkReports,
    Message,
    RobotReport,
    Status,
)
from maniple.core.scenario.types import Crash, Fault
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import start
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

ALIVE = {"controller": (1,), "r1": (1,), "r2": (2,), "recorder": (1,), "router": (1,), "simulator": (1,)}
KNOWN = Known(("r1", "r2"), ALIVE)


def formation(**changes: Any) -> FormationState:
    roster = tuple(
        RobotReport(id=name, state="present", odometry_age_s=0.05, mode="tracking", round_trip_s=trip)
        for name, trip in (("r1", 0.12), ("r2", -1.0))
    )
    given: dict[str, Any] = {
        "source": "controller",
        "phase": "running",
        "task_time_s": 12.3,
        "task_duration_s": 60.0,
        "reference": (0.0, 0.0, 0.0),
        "reference_velocity": (0.0, 0.0, 0.0),
        "chain": ("r1", "r2"),
        "errors": b"",
        "roster": roster,
    }
    return FormationState(**given | changes)


def status(robot: str, **changes: Any) -> Status:
    given: dict[str, Any] = {
        "source": robot,
        "mode": "tracking",
        "guard": "none",
        "command_age_s": 0.21,
        "command_age_max_s": 0.35,
        "driver": "active",
        "reason": "",
        "counters": {},
    }
    return Status(**given | changes)


def heard(*others: Message) -> dict[str, Message]:
    """What was just heard of a platoon that is well, but for `others`."""
    messages: list[tuple[str, Message]] = [
        (topics.FORMATION_STATE, formation()),
        *((topics.status(name), status(name)) for name in ("r1", "r2")),
        *((topics.status(one.source), one) for one in others if isinstance(one, Status)),
        *((topics.links(one.source), one) for one in others if isinstance(one, LinkReports)),
    ]
    return dict(messages)


def state(
    *others: Message,
    known: Known = KNOWN,
    said: EmergencyStop | None = None,
    plan: FaultPlan | None = None,
    **changes: Any,
) -> PlatoonState:
    return state_of(
        "tcp/h:1", known, heard(*others), formation(**changes), said, fault_text.report(plan, 5 * SECOND)
    )


def text(shown: PlatoonState, width: int = 80) -> list[str]:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(picture(shown))
    return [line.rstrip() for line in capture.get().splitlines()]


def test_a_platoon_that_is_well() -> None:
    well = state()
    assert (well.ok, well.controlled, well.phase) == (True, True, "running")
    assert [(robot.id, robot.lives, robot.round_trip_s) for robot in well.robots] == [
        ("r1", (1,), 0.12),
        ("r2", (2,), -1.0),
    ]
    assert text(well) == [
        "running, 12.3 of 60.0 s (tcp/h:1)",
        "2 of 2 robots there, controller, simulator, recorder, router",
        "faults: none",
        "robot   mode      guard  command age   worst  odometry age  round trip",
        "r1      tracking  none        0.21 s  0.35 s        0.05 s      0.12 s",
        "r2 (2)  tracking  none        0.21 s  0.35 s        0.05 s           -",
    ]
    assert text(well, 120) == text(well)


def test_a_robot_that_is_not_there() -> None:
    gone = state(known=Known(("r1", "r2"), {"controller": (1,), "r1": (1,)}), waits_for=("r2",))
    assert not gone.ok
    assert text(gone)[:2] == [
        "running, 12.3 of 60.0 s, waits for r2 (tcp/h:1)",
        "1 of 2 robots there, controller; not there: r2",
    ]
    assert text(gone)[5].startswith("r2     not there")


def test_a_recorder_that_does_not_record_is_told() -> None:
    recorders = (
        RecorderState("a-1", "recording", "", "a.mcap"),
        RecorderState("b-2", "paused", "lunch", "b.mcap"),
        RecorderState("c-3", "rolling", "", ""),
    )
    assert text(msgspec.structs.replace(state(), recorders=recorders))[2:5] == [
        "recorder b-2 is paused: lunch",
        "recorder c-3 only remembers the last seconds",
        "faults: none",
    ]


def test_who_is_waited_for_is_told_once() -> None:
    (first, *_) = text(state(waits_for=("r2",), reason="waits for r2: blind"))
    assert first == "running, 12.3 of 60.0 s: waits for r2: blind (tcp/h:1)"


def test_an_emergency_stop_holds_the_platoon_and_is_told_once() -> None:
    stop = EmergencyStop(stopped=True, reason="a dog")
    stopped = state(
        *(status(name, mode="emergency", reason="emergency stop: a dog") for name in ("r1", "r2")), said=stop
    )
    assert (stopped.ok, stopped.stopped, stopped.stop_reason) == (False, True, "a dog")
    assert text(stopped)[0] == "EMERGENCY STOP: a dog"
    assert sum("a dog" in line for line in text(stopped)) == 1
    assert state(said=EmergencyStop(stopped=False, reason="gone")).ok


def test_what_is_wrong_with_a_robot_is_said_below_the_table() -> None:
    bad = status(
        "r2", mode="holding", reason="the command is 2.1 s old", driver="configured", localised=False
    )
    lines = text(state(bad))
    assert lines[6] == "r2: the command is 2.1 s old; drive configured; does not know where it is"
    quiet = state_of("tcp/h:1", KNOWN, {}, formation(), None, fault_text.report(None, 0))
    assert "silent" in text(quiet)[4]
    assert text(quiet)[0] == "running, 12.3 of 60.0 s (as last heard) (tcp/h:1)"


def test_what_a_lost_robot_lacks_is_told() -> None:
    roster = (
        RobotReport(id="r1", state="present", odometry_age_s=0.05, mode="tracking"),
        RobotReport(id="r2", state="lost", odometry_age_s=0.05, mode="waiting"),
    )
    checks = (Check("r2", "heard", True), Check("r2", "stop tested", False, "its stop was not tested"))
    shown = state(roster=roster, preflight=checks)
    assert [robot.lacks for robot in shown.robots] == ["", "its stop was not tested"]
    assert text(shown)[6] == "r2: lost to the controller; lacks for the pre-flight check: its stop was not"
    present = state(preflight=checks)
    assert "lacks" not in "".join(text(present)), "then the controller's reason tells it"


def test_a_controller_that_never_was() -> None:
    nobody = state_of("tcp/h:1", Known((), {"router": (1,)}), {}, None, None, fault_text.report(None, 0))
    assert not nobody.ok
    assert text(nobody)[:2] == [
        "no controller has said anything yet (tcp/h:1)",
        "0 of 0 robots there, router; no controller",
    ]


def test_the_plan_is_one_line() -> None:
    plan = FaultPlan(
        since_ns=0,
        faults=(Fault(loss=0.5), Fault(latency_s=1.0, windows=((9.0, 10.0),))),
        crashes=(Crash(node="r1", at_s=1.0), Crash(node="r2", at_s=20.0)),
    )
    assert text(state(plan=plan))[2] == "faults: 2 rules (1 now), 2 crashes (1 now)"


def test_links_are_summed_over_topics_and_the_worst_come_first() -> None:
    links = LinkReports(
        source="controller",
        links=(
            LinkReport("r1", "robot/r1/odometry", 80, 20, 15, 0),
            LinkReport("r1", "robot/r1/status", 100, 0, 0, 3),
            LinkReport("r2", "robot/r2/odometry", 100, 0, 0, 0),
        ),
    )
    own = LinkReports(source="r1", links=(LinkReport("controller", "robot/r1/command", 50, 50, 50, 0),))
    shown = state(links, own)
    assert [(pair.source, pair.destination, pair.missing) for pair in pairs(shown.links)] == [
        ("controller", "r1", 50),
        ("r1", "controller", 20),
        ("r2", "controller", 0),
    ]
    assert [line.split() for line in text(shown)[-3:]] == [
        ["controller", "to", "r1", "50", "50.0", "%", "50.0", "%"],
        ["r1", "to", "controller", "180", "10.0", "%", "7.5", "%", "3"],
        ["1", "other", "link,", "nothing", "missing"],
    ]


@pytest.mark.parametrize("width", [80, 120])
def test_no_line_is_broken(width: int) -> None:
    """Names as long as they come, the longest words of every column."""
    bad = status("r1", mode="emergency", guard="acceleration", command_age_s=999.0, command_age_max_s=999.0)
    lines = text(state(bad), width)
    assert all(len(line) <= width for line in lines)
    assert len(lines) == len(text(state(bad), 200))


# -- with a real router


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Of a router that knows what a controller has said, and of nodes that show themselves and are silent."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohSession.router(address, "maniple") as router,
        ZenohSession.client(address, "maniple") as platoon,
    ):
        serve(router, Anchor.here())
        for node, lives in ALIVE.items():
            if node != "router":
                platoon.announce(node, lives[0])
        platoon.put(topics.FORMATION_STATE, codec.encode(formation(incarnation=1)))
        eventually(lambda: platoon.ask(topics.FORMATION_STATE))
        yield address


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command(endpoint: str) -> None:
    found = invoke("status", "--connect", endpoint, "--json")
    assert found.exit_code == 0, found.output
    shown = msgspec.json.decode(found.stdout, type=PlatoonState)
    assert (shown.ok, shown.controlled, shown.phase) == (True, False, "running")
    assert shown.nodes == ALIVE
    assert [robot.id for robot in shown.robots] == ["r1", "r2"]
    with ZenohSession.client(endpoint, "maniple") as other:
        stop = EmergencyStop(stopped=True, source="operator", incarnation=1)
        other.put(topics.STOP, codec.encode(stop))
        eventually(lambda: other.ask(topics.STOP))
    stopped = invoke("status", "--connect", endpoint)
    assert (stopped.exit_code, stopped.stdout.splitlines()[0]) == (1, "EMERGENCY STOP")


@pytest.mark.slow
def test_watching_goes_on_until_it_is_interrupted(endpoint: str) -> None:
    watching = start("status", "--watch", "--json", "--connect", endpoint)
    assert watching.stdout is not None
    shown = [json.loads(watching.stdout.readline()) for _ in range(2)]
    watching.send_signal(signal.SIGINT)
    _, err = watching.communicate(timeout=DEADLINE_S)
    assert (watching.returncode, err) == (130, "")
    assert [one["connect"] for one in shown] == [endpoint, endpoint]


def test_nobody_there_is_a_failure() -> None:
    nowhere = invoke("status", "--connect", "tcp/127.0.0.1:1", "--timeout", 0.3)
    assert isinstance(nowhere.exception, RunError)
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple"):
        alone = invoke("status", "--connect", address, "--json")
    assert (alone.exit_code, json.loads(alone.stdout)["phase"]) == (1, "")
