"""One message of every topic, with a number in every field."""

import pytest

from maniple.core import messages, topics
from maniple.core.messages import Message, Stamp, pack_floats
from maniple.core.scenario.types import Formation, Line, Sequence


def examples() -> dict[str, Message]:
    """By topic name."""
    scan = messages.Scan(
        first_angle_rad=-1.5,
        increment_rad=0.01,
        range_min_m=0.2,
        range_max_m=8.0,
        mount=(0.02, 0.0, 0.1),
        beams=pack_floats([[0.1, 0.0, -0.5], [0.1, 0.0, 0.0], [0.1, 0.0, 0.5]]),
        ranges=pack_floats([1.0, 2.5, 8.0]),
    )
    head = {"source": "r1", "incarnation": 2, "seq": 40, "stamp_ns": 10**18}
    made: dict[str, Message] = {
        topics.odometry("r1"): messages.Odometry(
            frame_id="r1/odom",
            x_m=1.5,
            y_m=-2.0,
            psi_rad=0.1,
            u_mps=0.2,
            w_radps=-0.1,
            applied=Stamp(1, 2, 3),
        ),
        topics.ranges("r1"): scan,
        topics.scan("r1"): scan,
        topics.status("r1"): messages.Status(
            mode="tracking",
            guard="none",
            command_age_s=0.05,
            command_age_max_s=0.1,
            driver="active",
            reason="",
            counters={"old": 3},
            compensation=(0.26, 0.25, 0.0, 1.0, 0.0, 1.1),
        ),
        topics.command("r1"): messages.Command(
            layer="drive", values=(0.1, -0.2), answers=Stamp(1, 9, 5), inputs_age_ns=10**6
        ),
        topics.FORMATION_STATE: messages.FormationState(
            phase="running",
            task_time_s=1.0,
            task_duration_s=10.0,
            reference=(1.0, 2.0, 3.0),
            reference_velocity=(0.1, 0.0, 0.0),
            chain=("r1", "r2", "r3"),
            errors=pack_floats([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]]),
            roster=(
                messages.RobotReport(
                    "r1", "present", 0.1, "tracking", (0.26, 0.25), memory=((), (0.1, 0.0, -0.2, 0.0))
                ),
            ),
            led=(messages.Led("p", 0, 1, -1.0),),
            points=pack_floats([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]),
        ),
        topics.FORMATION_MISSION: messages.Mission(
            number=3,
            stage="forming",
            seats=(messages.Seat("r1", 2, 1, "r1/odom", True),),
            task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
            points=((1.0, 0.0), (0.0, 1.0), (0.0, -1.0)),
            built_from=((1.0, 0.5),),
            progress=messages.Progress(1, 2, 3, 4),
        ),
        topics.FORMATION_GOAL: messages.Goal(
            id="op-1",
            task=Sequence(tasks=(Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),)),
            formation=Formation(points=((1.0, 0.0), (0.0, 1.0), (0.0, -1.0))),
            hold=False,
        ),
        topics.drive("r1"): messages.Drive(u_mps=0.1, w_radps=0.2, active=True),
        topics.motion("r1"): messages.Motion(
            ticks=(-5, 2**40), applied=(0.1, 0.2), state="active", controllable=True
        ),
        topics.TRUTH: messages.Truth(
            robots=("r1", "r2"),
            poses=pack_floats([[1, 2, 3], [4, 5, 6]]),
            velocities=pack_floats([[1, 2], [3, 4]]),
            clearances=pack_floats([0.5, 0.6]),
            collisions=0,
            contacts=("r1|r2",),
            sideways=pack_floats([0.0, -0.1]),
        ),
        topics.DECISIONS: messages.Decisions(
            decided=(messages.Decided("r1", topics.odometry("r1"), 1, 2, True, 3),)
        ),
        topics.journal("r1"): messages.Journal(
            calls=(messages.Call("message", 5, "t", "r1", 1, 2, 3, b"x"), messages.Call("timer", 6, "drive"))
        ),
        topics.HOST_ALIVE: messages.Alive(node="r1", node_incarnation=1, alive=True),
        topics.HOST_REFUSED: messages.Refused(topic="t", sender="r1", reason="old"),
        topics.HOST_COUNTERS: messages.Counters(counters={"x": 1}),
    }
    from msgspec.structs import replace

    return {name: replace(message, **head) for name, message in made.items()}


@pytest.fixture(params=examples().items(), ids=lambda item: item[0])
def example(request: pytest.FixtureRequest) -> tuple[str, Message]:
    """(topic name, a message of its type), once for every topic."""
    name, message = request.param
    return name, message
