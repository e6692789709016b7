import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.control import guard
from maniple.control.limits import Limits, Velocity
from maniple.control.returns import Returns
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Guard
from maniple.core.streams import stream

LIMITS = Limits(
    u_min=-0.75,
    u_max=0.75,
    w_max=1.745,
    u_accel=0.3,
    w_accel=1.745,
    brake=0.6,
    radius=0.332,
    gain=1.0,
    u_lag_s=0.0,
    w_lag_s=0.0,
    delay_s=0.0,
    needs_ranges=False,
    hold_s=1.0,
    stop_s=2.0,
)
OPEN = Guard(clearance=False)
CLEAR = Guard()
NOTHING = Returns(np.empty(0), np.empty(0), True, True)
DT = 0.05

speeds = st.floats(-3.0, 3.0) | st.sampled_from([math.inf, -math.inf, math.nan])
points = st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(-math.pi, math.pi)), max_size=5)


def returns(polar: list[tuple[float, float]], *, ahead: bool = True, behind: bool = True) -> Returns:
    return Returns(np.array([p[0] for p in polar]), np.array([p[1] for p in polar]), ahead, behind)


def step(
    state: Velocity,
    command: tuple[float, float] | None,
    age_s: float = 0.0,
    seen: Returns | None = None,
    parameters: Guard = OPEN,
    limits: Limits = LIMITS,
) -> guard.Verdict:
    """A step of a robot whose wheels do as they are told."""
    return guard.step(parameters, limits, state, command, age_s, seen, DT, state)


def steady(command: tuple[float, float], seen: Returns | None, parameters: Guard = CLEAR) -> guard.Verdict:
    """What the guard lets through in the end, if nothing changes."""
    verdict = guard.Verdict(0.0, 0.0, "none")
    for _ in range(400):
        state = Velocity(verdict.u, verdict.w)
        limits = LIMITS._replace(needs_ranges=parameters.clearance)
        verdict = step(state, command, 0.0, seen, parameters, limits)
    return verdict


def test_lets_a_modest_command_through() -> None:
    verdict = step(Velocity(0.2, 0.1), (0.21, 0.12), 0.5)
    assert verdict == (0.21, 0.12, "none")


@pytest.mark.parametrize(
    ("age", "share"), [(0.0, 1.0), (1.0, 1.0), (1.25, 0.75), (1.9, 0.1), (2.0, 0.0), (9.0, 0.0)]
)
def test_slows_with_age(age: float, share: float) -> None:
    verdict = step(Velocity(0.2 * share, 0.1 * share), (0.2, 0.1), age)
    assert (verdict.u, verdict.w) == pytest.approx((0.2 * share, 0.1 * share))
    assert verdict.reason == ("none" if share == 1.0 else "age")


def test_without_a_command_it_brakes_and_stands() -> None:
    verdict = step(Velocity(0.3, 0.0), None, 0.0)
    assert verdict.u == pytest.approx(0.3 - 0.6 * DT)
    assert verdict.reason == "acceleration"
    assert step(Velocity(), None, 0.0) == (0.0, 0.0, "age")


def test_a_robot_without_reverse_stands_instead() -> None:
    limits = LIMITS._replace(u_min=0.0)
    assert step(Velocity(), (-0.2, 0.05), 0.0, limits=limits) == (0.0, 0.05, "speed")


def test_hold_equal_to_stop_is_a_step() -> None:
    limits = LIMITS._replace(hold_s=2.0)
    assert step(Velocity(0.2, 0.0), (0.2, 0.0), 2.0, limits=limits).reason == "acceleration"
    assert step(Velocity(0.2, 0.0), (0.2, 0.0), 1.99, limits=limits).u == 0.2
    assert step(Velocity(), None, 1.0, limits=limits).u == 0.0


@settings(deadline=None, derandomize=True, max_examples=200)
@given(
    st.floats(-0.75, 0.75),
    st.floats(-1.745, 1.745),
    st.none() | st.tuples(speeds, speeds),
    st.floats(0.0, 3.0),
    st.none() | points,
    st.booleans(),
    st.floats(0.001, 0.2),
)
def test_never_beyond_what_the_robot_can_do(
    u: float,
    w: float,
    command: tuple[float, float] | None,
    age: float,
    polar: list[tuple[float, float]] | None,
    clearance: bool,
    dt: float,
) -> None:
    seen = None if polar is None else returns(polar)
    verdict = guard.step(
        Guard(clearance=clearance), LIMITS, Velocity(u, w), command, age, seen, dt, Velocity(u, w)
    )
    tiny = 1e-12
    assert abs(verdict.u) <= LIMITS.u_max + tiny
    assert abs(verdict.w) <= LIMITS.w_max + tiny
    assert abs(verdict.w - w) <= LIMITS.w_accel * dt + tiny
    assert abs(verdict.u) <= abs(u) + LIMITS.u_accel * dt + tiny
    if u * verdict.u > 0.0:
        assert abs(u) - abs(verdict.u) <= LIMITS.brake * dt + tiny
    else:  # it came to a stop on the way, and what was left of dt it gained speed
        assert abs(u) / LIMITS.brake + abs(verdict.u) / LIMITS.u_accel <= dt + tiny
    if age >= LIMITS.stop_s or command is None:
        assert abs(verdict.u) <= max(abs(u) - LIMITS.brake * dt, 0.0) + tiny


def test_approaches_no_faster_than_gamma_times_what_is_left() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    ahead = steady((0.5, 0.0), returns([(keep + 0.2, 0.0)]))
    assert ahead.u == pytest.approx(0.2)
    assert ahead.reason == "clearance"
    oblique = steady((0.5, 0.0), returns([(keep + 0.2, 1.0)]))
    assert oblique.u == pytest.approx(0.2 / math.cos(1.0))
    assert steady((0.5, 0.0), returns([(keep - 0.02, 0.3)])).u == 0.0
    assert steady((-0.5, 0.0), returns([(keep + 0.2, math.pi)])).u == pytest.approx(-0.2)


def test_what_is_far_or_abeam_of_a_straight_drive_or_behind_does_not_limit() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    for seen in ([(3.0, 0.0)], [(keep + 0.3, 1.57)], [(keep + 0.01, 3.0)], [(keep + 0.01, -3.0)]):
        assert steady((0.5, 0.0), returns(seen)) == (0.5, 0.0, "none")


def test_what_is_abeam_limits_a_fast_turn_towards_it_by_the_brakes() -> None:
    seen = returns([(LIMITS.radius + CLEAR.margin_m + 0.05, 1.5)])
    assert steady((0.7, 1.5), seen).u < 0.8 * steady((0.7, 0.0), seen).u


def test_what_is_behind_does_not_keep_it_from_leaving() -> None:
    assert steady((0.5, 0.0), returns([(LIMITS.radius, 3.0), (LIMITS.radius, 1.6)])) == (0.5, 0.0, "none")


def test_while_wheels_still_roll_towards_a_thing_it_does_not_turn_there() -> None:
    late = LIMITS._replace(u_lag_s=0.5)
    seen = returns([(LIMITS.radius + CLEAR.margin_m, 1.5)])
    for measured, turn in ((Velocity(0.3, 0.0), 0.0), (Velocity(0.3, 0.0), 1.0), (Velocity(), 1.0)):
        state = Velocity(0.0, turn)
        verdict = guard.step(CLEAR, late, state, (0.0, turn), 0.0, seen, DT, measured)
        rolls_there = bool(measured.u and turn)
        assert verdict.w == pytest.approx(turn - LIMITS.w_accel * DT if rolls_there else turn)
        assert verdict.reason == ("clearance" if rolls_there else "none")


def test_the_later_the_wheels_the_slower_the_approach() -> None:
    seen = returns([(LIMITS.radius + CLEAR.margin_m + 0.2, 0.0)])
    for lag, gamma in ((0.0, 1.0), (0.25, 1.0), (0.5, 2.0)):
        limits, verdict = LIMITS._replace(u_lag_s=lag), guard.Verdict(0.0, 0.0, "none")
        for _ in range(100):
            state = Velocity(verdict.u, verdict.w)
            verdict = guard.step(Guard(gamma_per_s=gamma), limits, state, (0.5, 0.0), 0.0, seen, DT, state)
        assert verdict.u == pytest.approx(0.2 * gamma / (1.0 + gamma * lag))


def test_may_turn_on_the_spot_next_to_anything() -> None:
    verdict = steady((0.5, 1.0), returns([(LIMITS.radius, 0.0)]))
    assert (verdict.u, verdict.w) == (0.0, 1.0)


def test_does_not_go_where_it_sees_nothing() -> None:
    front_laser = returns([], behind=False)
    assert steady((-0.3, 0.25), front_laser) == (0.0, 0.25, "blind")
    assert steady((0.3, 0.2), front_laser).u == pytest.approx(0.3)
    assert steady((0.3, 0.0), returns([], ahead=False)) == (0.0, 0.0, "blind")


def test_stands_still_while_it_knows_nothing_around_it() -> None:
    assert steady((0.3, 0.5), None) == (0.0, 0.0, "blind")
    assert steady((0.3, 0.5), None, OPEN) == (0.3, 0.5, "none")
    braking = step(Velocity(0.3, 0.5), (0.3, 0.5), limits=LIMITS._replace(needs_ranges=True))
    assert braking == (0.3 - 0.6 * DT, 0.5 - 1.745 * DT, "blind")


LATE = LIMITS._replace(gain=1.05, u_lag_s=0.56, w_lag_s=0.21, delay_s=0.1)
QUICK = LIMITS._replace(u_lag_s=0.26, w_lag_s=0.23, delay_s=0.1, u_accel=3.0)


class Wheels:
    """A robot whose speeds follow what its drive is told with a first-order lag, and its past."""

    def __init__(self, limits: Limits, step_s: float) -> None:
        self._gain, self._step_s = limits.gain, step_s
        self._keep = [math.exp(-step_s / lag) if lag else 0.0 for lag in (limits.u_lag_s, limits.w_lag_s)]
        self.past = [(Pose(0.0, 0.0, 0.0), Velocity())]

    def follow(self, u: float, w: float) -> Pose:
        pose, before = self.past[-1]
        kept_u, kept_w = self._keep
        after = Velocity(
            kept_u * before.u + (1 - kept_u) * self._gain * u,
            kept_w * before.w + (1 - kept_w) * self._gain * w,
        )
        mean_u, mean_w = 0.5 * (before.u + after.u), 0.5 * (before.w + after.w)
        self.past.append((pose.advance(mean_u * self._step_s, mean_w * self._step_s), after))
        return self.past[-1][0]


def seen_from(pose: Pose, obstacles: Floats) -> Returns:
    gap = obstacles - (pose.x, pose.y)
    bearing = np.angle(np.exp(1j * (np.arctan2(gap[:, 1], gap[:, 0]) - pose.psi)))
    return Returns(np.hypot(gap[:, 0], gap[:, 1]), bearing, True, True)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    st.integers(0, 10**6),
    st.sampled_from([0.05, 0.02, 0.1]),
    st.sampled_from([1.0, 4.0]),
    st.sampled_from([LIMITS, LATE, QUICK]),
)
def test_a_disc_never_touches_what_it_sees_whatever_it_is_told(
    seed: int, dt: float, gamma: float, limits: Limits
) -> None:
    """A perfect scanner all around, knowledge as old as may be, and commands that aim at the nearest thing
    or jump."""
    random = stream(seed, "guard")
    parameters = Guard(gamma_per_s=gamma)
    angle = random.uniform(-math.pi, math.pi, 12)
    reach = limits.radius + random.uniform(0.001, 1.5, 12)
    obstacles = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    allowed = min(float(reach.min()), limits.radius + 0.5 * parameters.margin_m) - 1e-9
    wheels, state, command = Wheels(limits, 0.01), Velocity(), (0.0, 0.0)
    old = round(limits.delay_s / 0.01)
    for tick in range(int(12.0 / dt)):
        pose, measured = wheels.past[max(-1 - old, -len(wheels.past))]
        seen = seen_from(pose, obstacles)
        nearest = int(seen.distance.argmin())
        if tick % 10 == 0:
            speed = float(random.choice([-2.0, 0.4, 2.0, 2.0]))
            turn = float(random.choice([-3.0, 0.0, 0.5, 3.0]))
            if random.random() < 0.5:
                turn = 3.0 * float(np.sign(seen.bearing[nearest]))
            command = (speed, turn)
        verdict = guard.step(parameters, limits, state, command, 0.0, seen, dt, measured)
        state = Velocity(verdict.u, verdict.w)
        for _ in range(round(dt / 0.01)):
            here = wheels.follow(*state)
            assert seen_from(here, obstacles).distance.min() >= allowed
