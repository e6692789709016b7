"""Figures from hand-made messages whose answers are known in closed form."""

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from maniple.cli.loading import completed
from maniple.core import topics
from maniple.core.geometry import Pose
from maniple.core.messages import (
    Call,
    Command,
    Decided,
    Decisions,
    FormationState,
    Journal,
    Odometry,
    Phase,
    RobotReport,
    Stamp,
    Status,
    Truth,
    pack_floats,
    unpack_floats,
)
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND
from maniple.report.summary import Errors, RunFigures, Summary

ARM = 0.25
POINTS = ((1.0, 0.0), (0.0, 0.8), (0.0, -0.8), (-1.0, 0.0))
BEGIN = 5 * SECOND
DURATION_S = 14.0
ZERO = Errors(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    table = {
        "name": "figures",
        "task": {"kind": "line", "start": [2, 1], "end": [2, 3], "speed_mps": 0.2, "settle_s": 4.0},
        "formation": {"points": POINTS},
        "robots": [{"id": f"r{i + 1}", "control_point_m": ARM} for i in range(4)],
    }
    return completed(msgspec.convert(table, Scenario))


def at(seconds: float) -> int:
    return BEGIN + round(seconds * SECOND)


def height(t_s: float) -> float:
    """Of the reference."""
    return 1.0 + 0.2 * min(max(t_s, 0.0), 10.0)


def truth(
    t_s: float,
    shift: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
    points: Sequence[tuple[float, float]] = POINTS,
    **changes: Any,
) -> Truth:
    """Control points in the desired formation at task time `t_s`, all shifted by `shift` and turned by
    `turn` about the middle of it; the robots look wherever they like."""
    y = height(t_s)
    middle = np.mean(points, axis=0)
    c, s = math.cos(math.pi / 2 + turn), math.sin(math.pi / 2 + turn)
    poses = []
    for index, point in enumerate(points):
        dx, dy = np.subtract(point, middle)
        px, py = 2.0 + shift[0] + c * dx - s * dy, y + shift[1] + s * dx + c * dy
        psi = 0.3 * index - 1.0
        poses.append((px - ARM * math.cos(psi), py - ARM * math.sin(psi), psi))
    values: dict[str, Any] = {
        "source": "simulator",
        "stamp_ns": at(t_s),
        "robots": ("r1", "r2", "r3", "r4"),
        "poses": pack_floats(poses),
        "velocities": pack_floats(np.zeros((4, 2))),
        "clearances": pack_floats([0.5, 0.6, 0.7, 0.8]),
        "collisions": 0,
    }
    return Truth(**values | changes)


def state(t_s: float, phase: Phase = "running", errors: Any = None, **changes: Any) -> FormationState:
    values: dict[str, Any] = {
        "source": "controller",
        "stamp_ns": at(t_s),
        "phase": phase,
        "task_time_s": min(max(t_s, 0.0), DURATION_S),
        "task_duration_s": DURATION_S,
        "reference": (2.0, height(t_s), math.pi / 2),
        "reference_velocity": (0.0, 0.0, 0.0),
        "chain": ("r1", "r2", "r3", "r4"),
        "errors": b"" if phase == "waiting" else pack_floats(np.zeros((2, 6)) if errors is None else errors),
        "roster": (),
    }
    return FormationState(**values | changes)


def a_run(scenario: Scenario, *more: Any, **options: Any) -> RunFigures:
    """Ground truth and states every 0.1 s from 1 s before the task to 1 s after it."""
    summary = Summary(scenario)
    for step in range(-10, 151):
        t_s = step / 10
        phase: Phase = "waiting" if t_s < 0 else "running" if t_s < DURATION_S else "done"
        summary.add(state(t_s, phase))
        summary.add(truth(t_s, **options))
    for message in more:
        summary.add(message)
    return summary.figures()


def test_nothing(scenario: Scenario) -> None:
    figures = Summary(scenario).figures()
    assert (figures.duration_s, figures.completed, figures.collisions) == (0.0, False, None)
    assert figures.min_clearance_m is None
    assert figures.final_error == figures.peak_error == figures.estimated_final_error == Errors()
    assert (figures.command_age_ms.p50, figures.command_age_ms.p99) == (None, None)
    assert figures.messages.sent == 0
    assert figures.without_truth == [robot.id for robot in scenario.robots]


def test_a_platoon_of_which_nothing_is_simulated_has_waited_as_long_as_the_controller_said(
    scenario: Scenario,
) -> None:
    summary = Summary(scenario)
    for t_s in (1.0, 4.0):
        summary.add(state(t_s, "waiting"))
    assert summary.figures().duration_s == pytest.approx(3.0)


def test_a_perfect_run(scenario: Scenario) -> None:
    figures = a_run(scenario)
    assert figures.completed
    assert figures.duration_s == pytest.approx(DURATION_S + 1.0)
    assert_errors(figures.final_error, ZERO)
    assert_errors(figures.peak_error, ZERO)
    assert_errors(figures.estimated_final_error, ZERO)
    assert figures.min_clearance_m == pytest.approx(0.5)


def assert_errors(found: Errors, expected: Errors, tolerance: float = 2e-6) -> None:
    """To what float32 resolves."""
    assert msgspec.structs.astuple(found) == pytest.approx(msgspec.structs.astuple(expected), abs=tolerance)


def test_a_shift_is_an_error_of_position_alone(scenario: Scenario) -> None:
    figures = a_run(scenario, shift=(0.3, -0.4))
    assert_errors(figures.final_error, Errors(0.5, 0.0, 0.0, 0.0))
    assert_errors(figures.peak_error, Errors(0.5, 0.0, 0.0, 0.0))


def test_a_turn_is_an_error_of_orientation_and_moves_the_middles_of_the_triangles(scenario: Scenario) -> None:
    """The middles of both triangles lie 1/3 from the middle of the formation, across it."""
    turn = 0.2
    figures = a_run(scenario, turn=turn)
    moved = 2 * math.sin(turn / 2) * (1.0 / 3.0)
    assert_errors(figures.final_error, Errors(moved, turn, 0.0, 0.0))


def test_a_stretched_triangle(scenario: Scenario) -> None:
    """r4 is 0.3 m too far back: the second triangle's middle moves by a third of that, and its sides and
    angle change; the formation is symmetric about the line it falls back on."""
    points = (*POINTS[:3], (-1.3, 0.0))
    shift = np.subtract(np.mean(points, axis=0), np.mean(POINTS, axis=0))
    back = (0.0, float(shift[0]))  # the formation's x is the world's y
    figures = a_run(scenario, points=points, shift=back)
    sides = {name: np.array(values) for name, values in zip("bcd", points[1:], strict=True)}
    was = {name: np.array(values) for name, values in zip("bcd", POINTS[1:], strict=True)}
    q = [np.linalg.norm(s["b"] - s["d"]) for s in (sides, was)]
    beta = [angle(s["b"], s["c"], s["d"]) for s in (sides, was)]
    assert figures.final_error.position_m == pytest.approx(0.1, abs=1e-6)
    assert figures.final_error.distance_m == pytest.approx(abs(q[0] - q[1]), abs=1e-6)
    assert figures.final_error.angle_rad == pytest.approx(abs(beta[0] - beta[1]), abs=1e-6)


def angle(corner: Any, one: Any, other: Any) -> float:
    a, b = one - corner, other - corner
    return abs(math.atan2(a[0] * b[1] - a[1] * b[0], float(a @ b)))


def test_the_peak_is_the_largest_and_the_final_the_mean_of_the_last_second(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for step in range(141):
        t_s = step / 10
        summary.add(state(t_s, "done" if t_s >= DURATION_S else "running"))
        aside = 2.0 if step == 37 else 0.1 * (step - 130) if step > 130 else 0.0
        summary.add(truth(t_s, shift=(aside, 0.0)))
    figures = summary.figures()
    assert figures.peak_error.position_m == pytest.approx(2.0, abs=1e-5)
    assert figures.final_error.position_m == pytest.approx(0.55, abs=1e-5)


def test_what_happens_before_and_after_the_task_is_no_error_but_a_collision(scenario: Scenario) -> None:
    stray = [
        truth(-2.0, shift=(9.0, 0.0), clearances=pack_floats([9, 9, 0.25, 9])),
        truth(DURATION_S + 2.0, shift=(9.0, 0.0), collisions=3, clearances=pack_floats([9, 0.125, 9, 9])),
    ]
    figures = a_run(scenario, *stray)
    assert_errors(figures.peak_error, ZERO)
    assert figures.collisions == 3
    assert figures.min_clearance_m == 0.125
    assert figures.duration_s == pytest.approx(DURATION_S + 2.0)


def test_order_does_not_matter(scenario: Scenario) -> None:
    messages = [
        m for step in range(141) for m in (state(step / 10), truth(step / 10, shift=(step / 100, 0.0)))
    ]
    figures = []
    for order in (messages, messages[::-1]):
        summary = Summary(scenario)
        for message in order:
            summary.add(message)
        figures.append(summary.figures())
    assert figures[0] == figures[1]
    assert not figures[0].completed


def test_a_run_cut_short_is_not_completed(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for step in range(30):
        summary.add(state(step / 10))
        summary.add(truth(step / 10, shift=(0.0, 0.2)))
    figures = summary.figures()
    assert not figures.completed
    assert figures.duration_s == pytest.approx(2.9)
    assert_errors(figures.final_error, Errors(0.2, 0.0, 0.0, 0.0))


def test_robots_that_were_never_ready(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for step in range(30):
        summary.add(state(step / 10, "waiting", task_time_s=0.0))
        summary.add(truth(step / 10))
    figures = summary.figures()
    assert not figures.completed
    assert figures.final_error == figures.estimated_final_error == Errors()
    assert figures.duration_s == pytest.approx(2.9)


def test_the_controllers_own_view(scenario: Scenario) -> None:
    """The largest over the triangles of each kind, whatever the sign; angles wrapped."""
    summary = Summary(scenario)
    errors = [[0.3, -0.4, 2 * math.pi - 0.1, 0.01, -0.02, 0.0], [0.0, 0.1, 0.05, 0.015, 0.0, -0.3]]
    for step in range(20):
        summary.add(state(step / 10, errors=errors))
    assert_errors(summary.figures().estimated_final_error, Errors(0.5, 0.1, 0.02, 0.3))


def status(age_s: float) -> Status:
    return Status(
        source="r1",
        mode="tracking",
        guard="none",
        command_age_s=age_s,
        command_age_max_s=age_s,
        driver="active",
        reason="",
        counters={},
    )


def test_percentiles_of_command_ages(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for age_ms in (*range(101), -1000, -1000):
        summary.add(status(age_ms / 1000))
    ages = summary.figures().command_age_ms
    assert ages.p50 == pytest.approx(50.0)
    assert ages.p99 == pytest.approx(99.0)


def test_links_are_counted(scenario: Scenario) -> None:
    summary = Summary(scenario)
    topic = topics.odometry("r1")
    summary.add(Journal(source="controller", calls=(Call("message", 0, topic, "r1", 1, 0),)))
    summary.add(Decisions(source="controller", decided=(Decided("r1", topic, 1, 0, False, 0),)))
    summary.add(Decisions(source="controller", decided=(Decided("r1", topic, 1, 1, True, 0),)))
    counts = summary.figures().messages
    assert (counts.sent, counts.delivered, counts.lost_injected, counts.lost_other) == (2, 1, 1, 0)


def test_what_matters_is_asked_for_and_the_rest_passed_over(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for topic in (topics.TRUTH, topics.FORMATION_STATE, topics.status("r1"), topics.journal("r1")):
        assert summary.wants(topic)
    for topic in (topics.scan("r1"), topics.command("r1"), "unheard/of", ""):
        assert not summary.wants(topic)
    summary.add(Command(layer="drive", values=(0.0, 0.0), answers=Stamp(1, 0, 0), inputs_age_ns=0))
    assert summary.figures() == Summary(scenario).figures()


def odometry(name: str, t_s: float, x: float, y: float, psi: float) -> Odometry:
    return Odometry(
        source=name, stamp_ns=at(t_s), frame_id=name, x_m=x, y_m=y, psi_rad=psi, u_mps=0.0, w_radps=0.0
    )


def test_where_the_chain_is_to_be_comes_from_the_controller(scenario: Scenario) -> None:
    """r2 is lost, the others change places on the way: only what was said then counts."""
    summary = Summary(scenario)
    places = (POINTS[2], POINTS[0], POINTS[3])
    gone = RobotReport("r2", "lost", 5.0, "")
    for step in range(100):
        t_s = step / 10
        early = t_s < 4.0
        spread = 1.0 + 0.1 * min(t_s, 3.0)
        chain = ("r1", "r2", "r3", "r4") if early else ("r3", "r1", "r4")
        wanted = np.multiply(POINTS if early else places, spread)
        summary.add(state(t_s, chain=chain, points=pack_floats(wanted), roster=() if early else (gone,)))
        spread = 1.0 + 0.1 * min(t_s + 0.05, 3.0)
        points = np.multiply(POINTS, spread)
        if not early:
            points[1] += 5.0
        shift = (-points.mean(axis=0)[1], points.mean(axis=0)[0])
        centred = truth(t_s + 0.05, points=[tuple(p) for p in points], shift=shift)
        summary.add(centred)
    figures = summary.figures()
    assert_errors(figures.peak_error, ZERO, 1e-5)
    assert_errors(figures.final_error, ZERO, 1e-5)
    assert figures.lost_robots == ["r2"]


def test_errors_count_from_when_the_formation_is_built(scenario: Scenario) -> None:
    summary = Summary(scenario)
    for step in range(40):
        built = step >= 20
        summary.add(state(step / 10, "running" if built else "forming"))
        summary.add(truth(step / 10, shift=(0.0 if built else 3.0, 0.0)))
    assert_errors(summary.figures().peak_error, ZERO)


def test_a_task_that_is_followed_by_another_is_not_done(scenario: Scenario) -> None:
    phases: list[Phase] = ["running", "done", "running", "running"]
    lasting: list[tuple[list[Phase], bool]] = [([], False), (["done", "done"], True)]
    for more, ends in lasting:
        summary = Summary(scenario)
        for step, phase in enumerate([*phases, *more]):
            summary.add(state(step / 10, phase))
            summary.add(truth(step / 10))
        figures = summary.figures()
        assert figures.completed == ends
        assert figures.duration_s == pytest.approx(0.4 if ends else 0.3)


def test_the_frame_of_a_robot_begins_at_its_initial_pose(scenario: Scenario) -> None:
    """The controller works in the frame of r2: what it says is where the world's reference is in it."""
    frame = Pose(*scenario.robots[1].pose)  # type: ignore[misc]
    summary = Summary(scenario)
    for step in range(20):
        t_s = step / 10
        wanted = frame.inverse().compose(Pose(2.0, height(t_s), math.pi / 2))
        summary.add(state(t_s, frame="r2", reference=tuple(wanted)))
        summary.add(truth(t_s, shift=(0.3, -0.4)))
    assert_errors(summary.figures().final_error, Errors(0.5, 0.0, 0.0, 0.0), 1e-5)


def test_what_dead_reckoning_explains(scenario: Scenario) -> None:
    """Every robot has turned by 0.1 rad more than it believes, about the middle of its axle; r3 believes to
    be 0.5 m ahead of where it is, but was not heard lately, and r4 is in no triangle."""
    summary = Summary(scenario)
    for step in range(41):
        t_s = step / 10
        summary.add(state(t_s, chain=("r1", "r2", "r3")))
        now = truth(t_s)
        summary.add(now)
        for index, (x, y, psi) in enumerate(unpack_floats(now.poses, 3)):
            robot = scenario.robots[index]
            origin = Pose(*robot.pose)  # type: ignore[misc]
            ahead = {2: 0.5, 3: 7.0}.get(index, 0.0)
            believed = origin.inverse().compose(Pose(x, y, psi - 0.1)).compose(Pose(ahead, 0.0, 0.0))
            if index != 2 or t_s < 3.0:
                summary.add(odometry(robot.id, t_s, *believed))
    found = summary.figures().odometry_drift_m
    turned = Pose(0.0, 0.0, -0.1).compose(Pose(ahead := 0.5 + ARM, 0.0, 0.0))
    assert found == pytest.approx(math.hypot(turned.x - ARM, turned.y), abs=1e-5)
    assert ahead == 0.75


def test_no_odometry_no_drift(scenario: Scenario) -> None:
    assert a_run(scenario).odometry_drift_m is None
    assert a_run(scenario).lost_robots == []


def test_a_platoon_far_off_is_out_of_formation() -> None:
    assert Errors().out_of_formation_m == 0.0
    assert Errors(position_m=0.1, distance_m=0.05).out_of_formation_m == 0.0
    assert Errors(position_m=0.1, distance_m=3.0).out_of_formation_m == 3.0
