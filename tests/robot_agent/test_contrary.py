import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.cli.loading import robot_models
from maniple.control.limits import Velocity
from maniple.core.scenario.types import RobotModel
from maniple.core.time import MILLISECOND, SECOND
from robot_agent.contrary import STUCK_AFTER, Contrary
from simulator.dynamics import VelocityDynamics
from tests.pioneer import PIONEER

TICK = 50 * MILLISECOND
FINE = 5
"""Steps of the dynamics in a tick."""
MODELS = robot_models()
HEAVY = replace(PIONEER, theta=(3.0, 2.0, 0.0, 1.0, 0.0, 1.0), u_max_mps=2.0)
STAND = Velocity()


class Vehicle:
    """A drive that follows as the dynamics of `model` do, with what it is told times `signs`; what is
    measured is the mean over a tick, as of wheels that count, and `late` ticks old."""

    def __init__(self, model: RobotModel, late: int = 0) -> None:
        self._dynamics = VelocityDynamics([model.theta], TICK / SECOND / FINE, sideways=True)
        self._velocity = np.zeros((3, 1))
        self._past = [STAND] * (late + 1)
        self.signs = (1.0, 1.0, 1.0)

    def follow(self, told: Velocity) -> Velocity:
        drive = self._dynamics.input_gain * (np.array(told) * self.signs)[:, None]
        passed = np.zeros(3)
        for _ in range(FINE):
            out = np.empty((3, 1))
            self._dynamics.step(self._velocity, drive, out)
            passed += 0.5 * (self._velocity + out)[:, 0] / FINE
            self._velocity = out
        self._past.append(Velocity(*passed.tolist()))
        return self._past.pop(0)


class Trial:
    def __init__(
        self, model: RobotModel = PIONEER, follow: Callable[[Velocity], Velocity] | None = None
    ) -> None:
        self.contrary = Contrary(model)
        self._follow = follow or Vehicle(model).follow
        self.now = 1000 * SECOND

    def tell(self, told: Velocity) -> str:
        self.contrary.tell(told, self.now)
        self.now += TICK
        return self.contrary.hear(self._follow(told), self.now)

    def found_after(self, told: Iterator[Velocity]) -> tuple[float, str]:
        """When it is found, s, and what; infinity where it is not."""
        begun = self.now
        for one in told:
            if found := self.tell(one):
                return (self.now - begun) / SECOND, found
        return math.inf, ""


def steady(told: Velocity, ticks: int = 200) -> Iterator[Velocity]:
    return iter([told] * ticks)


speeds = st.floats(-1.0, 1.0)
courses = st.lists(st.tuples(speeds, speeds, speeds, st.integers(1, 60)), min_size=1, max_size=12)
types = st.sampled_from([*MODELS.values(), HEAVY])


@settings(deadline=None, derandomize=True, max_examples=150)
@given(types, courses, st.integers(0, 4))
def test_a_drive_that_only_lags_is_never_contrary(
    model: RobotModel, course: list[tuple[float, float, float, int]], late: int
) -> None:
    """Steps from one end to the other, without any ramp, and reports that are up to 0.2 s late."""
    trial = Trial(model, Vehicle(model, late).follow)
    most = (model.u_max_mps, model.w_max_radps, model.v_max_mps or 0.0)
    for u, w, v, ticks in course:
        told = Velocity(u * most[0], w * most[1], v * most[2])
        for _ in range(ticks):
            assert trial.tell(told) == ""


@settings(deadline=None, derandomize=True, max_examples=100)
@given(
    st.sampled_from([PIONEER, MODELS["robotino"], MODELS["f1tenth"]]),
    st.sampled_from([0, 1, 2]),
    st.sampled_from([-1.0, 1.0]),
    st.lists(st.tuples(st.floats(1.0, 3.0), st.integers(1, 10)), min_size=30, max_size=30),
)
def test_a_drive_with_a_sign_crossed_is_found_within_1_5_s(
    model: RobotModel, axis: int, way: float, course: list[tuple[float, int]]
) -> None:
    """From a stand, with anything of one sign."""
    if axis == 2 and model.v_max_mps is None:
        axis = 0
    least = (0.11, 0.22, 0.11)[axis]
    vehicle = Vehicle(model)
    vehicle.signs = tuple(-1.0 if k == axis else 1.0 for k in range(3))  # type: ignore[assignment]
    told = (
        Velocity(*(way * share * least if k == axis else 0.0 for k in range(3)))
        for share, ticks in course
        for _ in range(ticks)
    )
    seconds, found = Trial(model, vehicle.follow).found_after(told)
    assert 1.0 < seconds < 1.5
    assert "for 1 s and" in found


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (Velocity(u=0.3), "told to drive forwards for 1 s and moves backwards (its motors, its compass)"),
        (Velocity(u=-0.3), "told to drive backwards for 1 s and moves forwards (its motors, its compass)"),
        (Velocity(w=0.5), "told to turn left for 1 s and turns right (its motors, its compass)"),
        (Velocity(w=-0.5), "told to turn right for 1 s and turns left (its motors, its compass)"),
        (Velocity(v=0.3), "told to drive left for 1 s and moves right (its motors, its compass)"),
        (Velocity(v=-0.3), "told to drive right for 1 s and moves left (its motors, its compass)"),
    ],
)
def test_it_says_what_the_robot_does(told: Velocity, words: str) -> None:
    model = MODELS["robotino"]
    vehicle = Vehicle(model)
    vehicle.signs = (-1.0, -1.0, -1.0)
    assert Trial(model, vehicle.follow).found_after(steady(told))[1] == words


def test_motors_that_cross_on_the_way_are_found() -> None:
    vehicle = Vehicle(PIONEER)
    trial = Trial(PIONEER, vehicle.follow)
    assert trial.found_after(steady(Velocity(u=0.3))) == (math.inf, "")
    vehicle.signs = (-1.0, 1.0, 1.0)
    assert trial.found_after(steady(Velocity(u=0.3)))[0] < 1.5


def test_a_heavy_one_may_take_its_time_to_turn_round() -> None:
    """From 2 m/s, with a lag of 3 s, that takes 3.6 s; one that never does is told apart from it."""
    vehicle = Vehicle(HEAVY)
    trial = Trial(HEAVY, vehicle.follow)
    assert trial.found_after(steady(Velocity(u=2.0), 400)) == (math.inf, "")
    assert trial.found_after(steady(Velocity(u=-0.8), 400)) == (math.inf, "")
    vehicle.signs = (-1.0, 1.0, 1.0)
    assert trial.found_after(steady(Velocity(u=-0.8), 400))[0] < 5.0


@pytest.mark.parametrize("told", [Velocity(u=0.09), Velocity(w=0.19), Velocity()])
def test_what_is_hardly_told_or_hardly_moves_is_not_contrary(told: Velocity) -> None:
    """Pushed about while it stands, and with the slip and the noise of a slow robot."""
    assert Trial(follow=lambda _: Velocity(-0.5, -0.5, -0.5)).found_after(steady(told)) == (math.inf, "")
    creeping = Trial(follow=lambda _: Velocity(-0.04, -0.08))
    assert creeping.found_after(steady(Velocity(0.5, 0.5))) == (math.inf, "")


def test_a_push_that_ends_or_a_command_that_turns_begins_anew() -> None:
    pushed = Trial(follow=lambda told: Velocity(u=-0.3))
    for _ in range(20):
        assert pushed.found_after(steady(Velocity(u=0.3), 18)) == (math.inf, "")
        assert pushed.tell(Velocity(u=-0.3)) == ""


def test_a_slow_robot_is_measured_by_what_it_can_do() -> None:
    slow = replace(PIONEER, u_max_mps=0.1, w_max_radps=0.2)
    vehicle = Vehicle(slow)
    vehicle.signs = (-1.0, -1.0, 1.0)
    assert Trial(slow, vehicle.follow).found_after(steady(Velocity(u=0.08)))[0] < 1.5


def test_what_was_told_before_a_silence_is_not_told_any_more() -> None:
    contrary, now = Contrary(PIONEER), 1000 * SECOND
    contrary.tell(Velocity(u=0.3), now)
    for _ in range(100):
        now += TICK
        assert contrary.hear(Velocity(u=-0.3), now) == ""


def test_what_does_not_move_though_it_is_told_to() -> None:
    moving = Vehicle(PIONEER)
    blocked: list[bool] = [True]
    trial = Trial(follow=lambda told: STAND if blocked[0] else moving.follow(told))
    begun = trial.now
    while not trial.contrary.stuck:
        assert trial.tell(Velocity(u=0.06)) == ""
    assert trial.now - begun == STUCK_AFTER + TICK
    blocked[0] = False
    trial.found_after(steady(Velocity(u=0.06), 20))
    assert not trial.contrary.stuck
    blocked[0] = True
    trial.found_after(steady(Velocity(u=0.04)))
    assert not trial.contrary.stuck
    trial.found_after(steady(Velocity(w=0.2)))
    assert trial.contrary.stuck
    trial.tell(STAND)
    assert not trial.contrary.stuck
