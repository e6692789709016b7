"""Fault plans that are changed while a platoon runs, over a real router."""

import json
import time
from collections.abc import Iterator
from io import StringIO
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from maniple.cli import fault_text
from maniple.cli.fault_command import app
from maniple.cli.operator import latched
from maniple.core import codec, topics
from maniple.core.errors import ArgumentError, ManipleError, RunError, ScenarioError
from maniple.core.messages import FaultPlan, FormationState, RobotReport
from maniple.core.plans import BLANK
from maniple.core.presets import PRESETS
from maniple.core.scenario.types import Burst, Crash, Fault, Freeze, Partition
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

BEGAN_S = 7
LATER_S = 60.0
"""By then any of these tests is over."""

STATE = FormationState(
    source="controller",
    incarnation=1,
    seq=0,
    stamp_ns=0,
    phase="running",
    task_time_s=0.0,
    task_duration_s=1.0,
    reference=(0.0, 0.0, 0.0),
    reference_velocity=(0.0, 0.0, 0.0),
    chain=("r1", "r2", "r3"),
    errors=b"",
    roster=tuple(
        RobotReport(id=f"r{i}", state="present", odometry_age_s=0.0, mode="tracking") for i in (1, 2, 3)
    ),
)


@pytest.fixture
def router() -> Iterator[tuple[str, ZenohSession]]:
    """The endpoint of a router of a run that is at 7 s, with three robots, and a session of it."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple") as opened:
        serve(opened, Anchor(BEGAN_S * SECOND, time.monotonic_ns(), 1.0))
        with ZenohSession.client(address, "maniple") as session:
            session.announce("controller", STATE.incarnation)
            session.put(topics.FORMATION_STATE, codec.encode(STATE))
            eventually(lambda: latched(session, topics.FORMATION_STATE))
            yield address, session


@pytest.fixture
def endpoint(router: tuple[str, ZenohSession]) -> str:
    return router[0]


@pytest.fixture
def session(router: tuple[str, ZenohSession]) -> ZenohSession:
    return router[1]


def invoke(endpoint: str, *arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments), "--connect", endpoint, "--timeout", "20"])


def done(endpoint: str, *arguments: object) -> dict[str, Any]:
    """What `--json` says of a command that does what it is told."""
    result = invoke(endpoint, *arguments, "--json")
    assert not isinstance(result.exception, ManipleError), result.exception
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def plan_of(session: ZenohSession) -> FaultPlan:
    plan = latched(session, topics.PLAN)
    assert isinstance(plan, FaultPlan)
    return plan


def refused(endpoint: str, *arguments: object) -> str:
    """Why a command is not obeyed; nothing is changed then."""
    result = invoke(endpoint, *arguments)
    assert isinstance(result.exception, ArgumentError | ScenarioError), (result.output, result.exception)
    said = str(result.exception)
    return said.removeprefix(f"{endpoint}: ")


def test_nothing_is_planned_at_first(endpoint: str) -> None:
    found = done(endpoint, "show")
    assert found == {
        "since_ns": None,
        "elapsed_s": None,
        "rules": [],
        "partitions": [],
        "crashes": [],
        "freezes": [],
        "connect": endpoint,
    }
    assert invoke(endpoint, "show").stdout == f"no faults are planned ({endpoint})\n"


def test_every_number_of_a_rule(endpoint: str, session: ZenohSession) -> None:
    link = ("--from", "r3", "--to", "controller", "--topic", "robot/*/odometry")
    numbers = ("--latency", 0.2, "--jitter", 0.05, "--loss", 0.1, "--duplicate", 0.02, "--corrupt", 0.01)
    bursts = ("--burst-enter", 0.1, "--burst-leave", 0.5, "--burst-loss-good", 0.01, "--burst-loss-bad", 0.9)
    rest = ("--reorder", 0.3, "--reorder-by", 0.4, "--rate-kbps", 500, "--queue", 0.7, "--window", "10:20")
    found = done(endpoint, "set", *link, *numbers, *bursts, *rest)
    plan = plan_of(session)
    assert plan.faults == (
        Fault(
            source="r3",
            destination="controller",
            topic="robot/*/odometry",
            latency_s=0.2,
            jitter_s=0.05,
            loss=0.1,
            burst=Burst(enter=0.1, leave=0.5, loss_good=0.01, loss_bad=0.9),
            duplicate=0.02,
            reorder=0.3,
            reorder_s=0.4,
            corrupt=0.01,
            rate_kbps=500.0,
            queue_s=0.7,
            windows=((10.0, 20.0),),
        ),
    )
    assert plan.since_ns == BEGAN_S * SECOND
    assert plan.source == "operator"
    (rule,) = found["rules"]
    assert (rule["number"], rule["state"], rule["loss"]) == (0, "to come", 0.1)
    assert found == done(endpoint, "show") | {"elapsed_s": found["elapsed_s"]}


def test_rules_are_replaced_added_and_cleared_and_keep_their_numbers(
    endpoint: str, session: ZenohSession
) -> None:
    for robot in ("r1", "r2", "r3"):
        done(endpoint, "set", "--from", robot, "--loss", 0.5)
    done(endpoint, "set", "--from", "r2", "--loss", 0.1)
    done(endpoint, "set", "--from", "r1", "--latency", 0.1, "--add")
    r1, r2, r3 = (Fault(source=name, loss=0.5) for name in ("r1", "r2", "r3"))
    better, late = Fault(source="r2", loss=0.1), Fault(source="r1", latency_s=0.1)
    assert plan_of(session).faults == (r1, better, r3, late)
    found = done(endpoint, "clear", 1)
    assert [rule["number"] for rule in found["rules"]] == [0, 2, 3]
    assert plan_of(session).faults == (r1, BLANK, r3, late)
    found = done(endpoint, "clear", "--from", "r1")
    assert plan_of(session).faults == (BLANK, BLANK, r3)
    assert refused(endpoint, "clear", 1) == "rule 1: is not there; rules are 2 (r3 to all)"
    assert refused(endpoint, "clear", "--from", "r1") == "no rule was set for that; rules are 2 (r3 to all)"
    assert done(endpoint, "clear", "--all")["rules"] == []
    assert r2.loss == 0.5


def test_from_now_is_soon_by_the_clock_of_the_run(endpoint: str, session: ZenohSession) -> None:
    done(endpoint, "set", "--preset", "lte", "--for", 5)
    done(endpoint, "partition", "r1,r2", "r3", "--for", 6)
    done(endpoint, "crash", "r1", "--restart-after", 7)
    done(endpoint, "freeze", "r2", "--for", 8)
    found = done(endpoint, "crash", "r3")
    plan = plan_of(session)
    ((begin, end),) = plan.faults[0].windows
    assert 0 < begin < LATER_S
    assert end - begin == pytest.approx(5.0)
    assert plan.faults[0].latency_s == PRESETS["lte"].latency_s
    assert [one.groups for one in plan.partitions] == [(("r1", "r2"), ("r3",))]
    assert plan.partitions[0].for_s == 6.0
    assert [(one.node, one.restart_after_s) for one in plan.crashes] == [("r1", 7.0), ("r3", None)]
    assert [(one.node, one.for_s) for one in plan.freezes] == [("r2", 8.0)]
    times = [begin, plan.partitions[0].at_s, plan.crashes[0].at_s, plan.freezes[0].at_s, plan.crashes[1].at_s]
    assert times == sorted(times)
    assert found["elapsed_s"] < LATER_S
    assert done(endpoint, "clear", "--partitions", "--node", "r3")["partitions"] == []
    assert [one.node for one in plan_of(session).crashes] == ["r1"]
    assert "r9: no crash or freeze of it is planned; of r1, r2" in refused(endpoint, "clear", "--node", "r9")


def test_what_is_over_is_pruned_when_a_plan_is_changed(endpoint: str, session: ZenohSession) -> None:
    old = FaultPlan(
        source="router",
        incarnation=1,
        since_ns=(BEGAN_S - 5) * SECOND,
        faults=(Fault(windows=((1, 2),)), Fault(source="r1", loss=0.1)),
        freezes=(Freeze(node="r1", at_s=1, for_s=1),),
    )
    session.put(topics.PLAN, codec.encode(old))
    eventually(lambda: latched(session, topics.PLAN))
    assert [rule["state"] for rule in done(endpoint, "show")["rules"]] == ["over", "running"]
    done(endpoint, "set", "--from", "r2", "--loss", 0.3)
    plan = plan_of(session)
    assert plan.since_ns == old.since_ns
    assert plan.freezes == ()
    assert plan.faults == (Fault(source="r2", loss=0.3), Fault(source="r1", loss=0.1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("set", "--from", "r9", "--loss", 0.1),
            "--from = 'r9': matches nothing; valid: controller, r1, r2, r3",
        ),
        (("set", "--to", "x*", "--loss", 0.1), "--to = 'x*': matches nothing; valid: controller, r1"),
        (
            ("set", "--topic", "odometry", "--loss", 0.1),
            "--topic = 'odometry': matches nothing; valid: robot/r1/",
        ),
        (("set", "--loss", 1.5), "--loss = 1.5: must be a finite number >= 0 and <= 1"),
        (("set", "--latency", -1), "--latency = -1.0: must be"),
        (("set", "--latency", "nan"), "--latency = nan: must be"),
        (("set", "--burst-leave", 0.5), "--burst-enter: missing"),
        (("set", "--preset", "wlan"), "--preset = 'wlan': must be one of wifi-good, "),
        (
            ("set", "--loss", 0.1, "--window", "20:10"),
            "--window = [20.0, 10.0]: is empty; must be [from, to) with from < to",
        ),
        (("set", "--loss", 0.1, "--for", 0), "--for = 0.0: must be a finite number > 0"),
        (("set", "--from", "r1", "--to", "r2", "--loss", 0.1), "--from r1 --to r2: no message goes that way"),
        (("set", "--queue", 2), "--queue: is for what comes faster than a rate; give --rate-kbps too"),
        (("set", "--reorder-by", 2), "--reorder-by: says for how long, not how many; give --reorder too"),
        (("crash", "r1", "--restart-after", 0), "--restart-after = 0.0: must be"),
        (("partition", "r1", "r1,r2"), "r1 is in groups[0] already"),
        (("partition", "r7"), "'r7': matches nothing; valid: controller, r1"),
        (("partition", "r1", "--for", -1), "--for = -1.0: must be"),
        (("crash", "simulator"), "'simulator': its death ends the run; must be one of controller, recorder"),
        (("crash", "r9"), "'r9': must be one of controller, recorder, router, r1, r2, r3"),
        (("crash", "r 9"), "NODE = 'r 9': must be"),
        (("freeze", "r9", "--for", 1), "'r9': must be one of controller, simulator, recorder"),
    ],
)
def test_what_is_refused_says_what_would_be_valid(
    endpoint: str, session: ZenohSession, arguments: tuple[object, ...], message: str
) -> None:
    assert message in refused(endpoint, *arguments)
    assert latched(session, topics.PLAN) is None


@pytest.mark.parametrize(
    "arguments",
    [
        ("set",),
        ("set", "--from", "r1"),
        ("set", "--loss", "much"),
        ("set", "--loss", 0.1, "--window", "10"),
        ("set", "--loss", 0.1, "--window", "1:2", "--for", 3),
        ("clear",),
        ("clear", "first"),
        ("partition",),
        ("crash",),
        ("freeze", "r1"),
        ("thaw", "r1"),
    ],
)
def test_wrong_usage_is_status_2(arguments: tuple[object, ...]) -> None:
    assert invoke("tcp/127.0.0.1:1", *arguments).exit_code == 2


def test_nobody_there_is_a_failure() -> None:
    result = CliRunner().invoke(app, ["show", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.3"])
    assert isinstance(result.exception, RunError)
    assert "can't reach a router at tcp/127.0.0.1:1" in str(result.exception)


def test_answers_and_refusals_say_which_platoon(endpoint: str) -> None:
    assert done(endpoint, "set", "--loss", 0.1)["connect"] == endpoint
    assert f"s since the start ({endpoint})" in invoke(endpoint, "show").stdout
    wrong = invoke(endpoint, "set", "--from", "r9", "--loss", 0.1).exception
    assert str(wrong).startswith(f"{endpoint}: --from = 'r9'")


def test_a_platoon_that_nobody_has_heard_of_is_told() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple") as opened:
        serve(opened, Anchor(BEGAN_S * SECOND, time.monotonic_ns(), 1.0))
        said = refused(address, "set", "--from", "r1", "--loss", 0.1)
    assert "--from = 'r1': matches nothing" in said
    assert "no robot is known there yet" in said


def test_a_plan_as_people_see_it() -> None:
    plan = FaultPlan(
        since_ns=100 * SECOND,
        faults=(
            BLANK,
            Fault(source="r3", topic="robot/*/odometry", latency_s=0.2, jitter_s=0.05, loss=0.3),
            Fault(burst=Burst(enter=0.01, leave=0.5), rate_kbps=100, windows=((1, 2), (30, 40.5))),
        ),
        partitions=(Partition(groups=(("r1", "r2"), ("r3",)), at_s=5, for_s=5),),
        crashes=(Crash(node="r4", at_s=20, restart_after_s=5), Crash(node="r5", at_s=1)),
        freezes=(Freeze(node="router", at_s=9.5, for_s=3),),
    )
    console = Console(file=StringIO(), width=200)
    console.print(fault_text.picture(plan, 110 * SECOND, "tcp/h:1"))
    assert isinstance(console.file, StringIO)
    lines = [" ".join(line.split()) for line in console.file.getvalue().splitlines()]
    assert lines == [
        "10.0 s since the start (tcp/h:1)",
        "who what when now",
        "1 r3 to all: robot/*/odometry 200 +- 50 ms late, 30 % lost always running",
        "2 all to all bursts (enter 1 %, leave 50 %; 100 % lost, else 0 %), 100 kbit/s, queue of 1 s "
        "1 to 2 s, 30 to 40.5 s to come",
        "r1,r2 | r3 | all others partition from 5 s for 5 s over",
        "r4 crash, back after 5 s at 20 s to come",
        "r5 crash at 1 s running",
        "router freeze from 9.5 s for 3 s running",
    ]


def test_every_field_of_a_rule_is_told() -> None:
    full = Fault(
        latency_s=0.1,
        loss=0.1,
        burst=Burst(enter=0.1, leave=0.2),
        duplicate=0.1,
        reorder=0.1,
        corrupt=0.1,
        rate_kbps=10,
        preset="lte",
    )
    text = fault_text.summary(full)
    for word in (
        "lte",
        "100 ms late",
        "lost",
        "bursts",
        "twice",
        "held back by 200 ms",
        "corrupted",
        "kbit/s",
    ):
        assert word in text
    assert fault_text.summary(Fault()) == "nothing"
