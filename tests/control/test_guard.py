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
    command: tuple[float, ...] | None,
    age_s: float = 0.0,
    seen: Returns | None = None,
    parameters: Guard = OPEN,
    limits: Limits = LIMITS,
) -> guard.Verdict:
    """A step of a robot whose wheels do as they are told."""
    wanted = None if command is None else Velocity(*command)
    return guard.step(parameters, limits, state, wanted, age_s, seen, DT, state)


def verdict_of(u: float, w: float, reason: guard.Reason, v: float = 0.0) -> guard.Verdict:
    return guard.Verdict(Velocity(u, w, v), reason)


def steady(command: tuple[float, float], seen: Returns | None, parameters: Guard = CLEAR) -> guard.Verdict:
    """What the guard lets through in the end, if nothing changes."""
    verdict = guard.Verdict(Velocity(), "none")
    for _ in range(400):
        state = verdict.velocity
        limits = LIMITS._replace(needs_ranges=parameters.clearance)
        verdict = step(state, command, 0.0, seen, parameters, limits)
    return verdict


def test_lets_a_modest_command_through() -> None:
    verdict = step(Velocity(0.2, 0.1), (0.21, 0.12), 0.5)
    assert verdict == verdict_of(0.21, 0.12, "none")


@pytest.mark.parametrize(
    ("age", "share"), [(0.0, 1.0), (1.0, 1.0), (1.25, 0.75), (1.9, 0.1), (2.0, 0.0), (9.0, 0.0)]
)
def test_slows_with_age(age: float, share: float) -> None:
    verdict = step(Velocity(0.2 * share, 0.1 * share), (0.2, 0.1), age)
    assert (verdict.velocity.u, verdict.velocity.w) == pytest.approx((0.2 * share, 0.1 * share))
    assert verdict.reason == ("none" if share == 1.0 else "age")


def test_without_a_command_it_brakes_and_stands() -> None:
    verdict = step(Velocity(0.3, 0.0), None, 0.0)
    assert verdict.velocity.u == pytest.approx(0.3 - 0.6 * DT)
    assert verdict.reason == "acceleration"
    assert step(Velocity(), None, 0.0) == verdict_of(0.0, 0.0, "age")


def test_a_robot_without_reverse_stands_instead() -> None:
    limits = LIMITS._replace(u_min=0.0)
    assert step(Velocity(), (-0.2, 0.05), 0.0, limits=limits) == verdict_of(0.0, 0.05, "speed")


def test_hold_equal_to_stop_is_a_step() -> None:
    limits = LIMITS._replace(hold_s=2.0)
    assert step(Velocity(0.2, 0.0), (0.2, 0.0), 2.0, limits=limits).reason == "acceleration"
    assert step(Velocity(0.2, 0.0), (0.2, 0.0), 1.99, limits=limits).velocity.u == 0.2
    assert step(Velocity(), None, 1.0, limits=limits).velocity.u == 0.0


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
    wanted = None if command is None else Velocity(*command)
    verdict = guard.step(
        Guard(clearance=clearance), LIMITS, Velocity(u, w), wanted, age, seen, dt, Velocity(u, w)
    )
    tiny = 1e-12
    assert abs(verdict.velocity.u) <= LIMITS.u_max + tiny
    assert abs(verdict.velocity.w) <= LIMITS.w_max + tiny
    assert abs(verdict.velocity.w - w) <= LIMITS.w_accel * dt + tiny
    assert abs(verdict.velocity.u) <= abs(u) + LIMITS.u_accel * dt + tiny
    if u * verdict.velocity.u > 0.0:
        assert abs(u) - abs(verdict.velocity.u) <= LIMITS.brake * dt + tiny
    else:  # it came to a stop on the way, and what was left of dt it gained speed
        assert abs(u) / LIMITS.brake + abs(verdict.velocity.u) / LIMITS.u_accel <= dt + tiny
    if age >= LIMITS.stop_s or command is None:
        assert abs(verdict.velocity.u) <= max(abs(u) - LIMITS.brake * dt, 0.0) + tiny


def test_approaches_no_faster_than_gamma_times_what_is_left() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    ahead = steady((0.5, 0.0), returns([(keep + 0.2, 0.0)]))
    assert ahead.velocity.u == pytest.approx(0.2)
    assert ahead.reason == "clearance"
    oblique = steady((0.5, 0.0), returns([(keep + 0.2, 1.0)]))
    assert oblique.velocity.u == pytest.approx(0.2 / math.cos(1.0))
    assert steady((0.5, 0.0), returns([(keep - 0.02, 0.3)])).velocity.u == 0.0
    assert steady((-0.5, 0.0), returns([(keep + 0.2, math.pi)])).velocity.u == pytest.approx(-0.2)


def test_what_is_far_or_abeam_of_a_straight_drive_or_behind_does_not_limit() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    for seen in ([(3.0, 0.0)], [(keep + 0.3, 1.57)], [(keep + 0.01, 3.0)], [(keep + 0.01, -3.0)]):
        assert steady((0.5, 0.0), returns(seen)) == verdict_of(0.5, 0.0, "none")


def test_what_is_abeam_limits_a_fast_turn_towards_it_by_the_brakes() -> None:
    seen = returns([(LIMITS.radius + CLEAR.margin_m + 0.05, 1.5)])
    assert steady((0.7, 1.5), seen).velocity.u < 0.8 * steady((0.7, 0.0), seen).velocity.u


def test_what_is_behind_does_not_keep_it_from_leaving() -> None:
    assert steady((0.5, 0.0), returns([(LIMITS.radius, 3.0), (LIMITS.radius, 1.6)])) == verdict_of(
        0.5, 0.0, "none"
    )


def test_while_wheels_still_roll_towards_a_thing_it_does_not_turn_there() -> None:
    late = LIMITS._replace(u_lag_s=0.5)
    seen = returns([(LIMITS.radius + CLEAR.margin_m, 1.5)])
    for measured, turn in ((Velocity(0.3, 0.0), 0.0), (Velocity(0.3, 0.0), 1.0), (Velocity(), 1.0)):
        state = Velocity(0.0, turn)
        verdict = guard.step(CLEAR, late, state, Velocity(0.0, turn), 0.0, seen, DT, measured)
        rolls_there = bool(measured.u and turn)
        assert verdict.velocity.w == pytest.approx(turn - LIMITS.w_accel * DT if rolls_there else turn)
        assert verdict.reason == ("clearance" if rolls_there else "none")


def test_the_later_the_wheels_the_slower_the_approach() -> None:
    seen = returns([(LIMITS.radius + CLEAR.margin_m + 0.2, 0.0)])
    for lag, gamma in ((0.0, 1.0), (0.25, 1.0), (0.5, 2.0)):
        limits, verdict = LIMITS._replace(u_lag_s=lag), guard.Verdict(Velocity(), "none")
        for _ in range(100):
            state = verdict.velocity
            verdict = guard.step(Guard(gamma_per_s=gamma), limits, state, Velocity(0.5), 0.0, seen, DT, state)
        assert verdict.velocity.u == pytest.approx(0.2 * gamma / (1.0 + gamma * lag))


def test_may_turn_on_the_spot_next_to_anything() -> None:
    verdict = steady((0.5, 1.0), returns([(LIMITS.radius, 0.0)]))
    assert (verdict.velocity.u, verdict.velocity.w) == (0.0, 1.0)


def test_does_not_go_where_it_sees_nothing() -> None:
    front_laser = returns([], behind=False)
    assert steady((-0.3, 0.25), front_laser) == verdict_of(0.0, 0.25, "blind")
    assert steady((0.3, 0.2), front_laser).velocity.u == pytest.approx(0.3)
    assert steady((0.3, 0.0), returns([], ahead=False)) == verdict_of(0.0, 0.0, "blind")


def test_stands_still_while_it_knows_nothing_around_it() -> None:
    assert steady((0.3, 0.5), None) == verdict_of(0.0, 0.0, "blind")
    assert steady((0.3, 0.5), None, OPEN) == verdict_of(0.3, 0.5, "none")
    braking = step(Velocity(0.3, 0.5), (0.3, 0.5), limits=LIMITS._replace(needs_ranges=True))
    assert braking == verdict_of(0.3 - 0.6 * DT, 0.5 - 1.745 * DT, "blind")


LATE = LIMITS._replace(gain=1.05, u_lag_s=0.56, w_lag_s=0.21, delay_s=0.1)
QUICK = LIMITS._replace(u_lag_s=0.26, w_lag_s=0.23, delay_s=0.1, u_accel=3.0)
ROUND = LIMITS._replace(v_max=0.75)
LATE_ROUND = LATE._replace(v_max=0.75)
CAR = LIMITS._replace(curvature=1.35, centre=0.17, swing=math.atan(1.35 * 0.17))
LATE_CAR = CAR._replace(gain=1.05, u_lag_s=0.3, w_lag_s=0.13, delay_s=0.1)


def test_a_car_does_not_turn_more_than_its_steering_allows() -> None:
    car = LIMITS._replace(curvature=1.3)
    assert step(Velocity(), (0.0, 1.0), limits=car) == verdict_of(0.0, 0.0, "speed")
    verdict = step(Velocity(), (0.5, 0.5), limits=car)
    assert verdict.velocity == pytest.approx((0.3 * DT, 1.3 * 0.3 * DT, 0.0))
    assert verdict.reason == "acceleration"
    verdict = step(Velocity(0.1, 0.13), (0.0, 0.13), limits=car)
    assert verdict.velocity.w <= 1.3 * verdict.velocity.u


def test_a_wide_cone_limits_as_if_the_thing_were_at_its_nearer_edge() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    axis = returns([(keep + 0.1, 1.2)])
    edge = returns([(keep + 0.1, 0.9)])
    wide = steady((0.7, 0.0), axis._replace(half_cone=0.3))
    assert wide.velocity == pytest.approx(steady((0.7, 0.0), edge).velocity)
    assert steady((0.7, 0.0), axis).velocity.u > steady((0.7, 0.0), edge).velocity.u


def test_a_robot_that_moves_any_way_is_limited_in_the_way_it_goes() -> None:
    keep = LIMITS.radius + CLEAR.margin_m
    wall = returns([(keep + 0.2, math.pi / 2)])
    state = Velocity()
    for _ in range(400):
        verdict = guard.step(CLEAR, ROUND, state, Velocity(0.2, 0.0, 0.4), 0.0, wall, DT, state)
        state = verdict.velocity
    closing = verdict.velocity.v
    assert verdict.reason == "clearance"
    assert 0.15 < closing < 0.25
    away = guard.step(CLEAR, ROUND, state, Velocity(0.2, 0.0, -0.4), 0.0, wall, DT, Velocity())
    assert away.reason == "acceleration"
    front = returns([], behind=False)
    assert guard.step(CLEAR, ROUND, Velocity(), Velocity(0.1, 0.0, 0.4), 0.0, front, DT, Velocity()) == (
        Velocity(0.015, 0.0, 0.0),
        "blind",
    )


class Wheels:
    """A robot whose speeds follow what its drive is told with a first-order lag, and its past."""

    def __init__(self, limits: Limits, step_s: float) -> None:
        self._gain, self._step_s, self._limits = limits.gain, step_s, limits
        self._keep = [math.exp(-step_s / lag) if lag else 0.0 for lag in (limits.u_lag_s, limits.w_lag_s)]
        self.past = [(Pose(0.0, 0.0, 0.0), Velocity())]

    def follow(self, told: Velocity) -> Pose:
        pose, before = self.past[-1]
        keep = (self._keep[0], self._keep[1], self._keep[0])
        after = Velocity(
            *(k * old + (1 - k) * self._gain * new for k, old, new in zip(keep, before, told, strict=True))
        )
        if self._limits.curvature < math.inf:
            most = self._limits.curvature * abs(after.u)
            after = after._replace(w=max(-most, min(most, after.w)))
        u, w, v = (0.5 * (old + new) * self._step_s for old, new in zip(before, after, strict=True))
        self.past.append((pose.advance(u, w, v), after))
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
    st.sampled_from([LIMITS, LATE, QUICK, ROUND, LATE_ROUND, CAR, LATE_CAR]),
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
    obstacles = np.stack([limits.centre + reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    allowed = min(float(reach.min()), limits.radius + 0.5 * parameters.margin_m) - 1e-9
    wheels, state, command = Wheels(limits, 0.01), Velocity(), Velocity()
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
            side = float(random.choice([-1.0, 0.0, 1.0])) if limits.v_max else 0.0
            if limits.v_max and random.random() < 0.7:
                bearing = float(seen.bearing[nearest])
                speed, side = 2.0 * math.cos(bearing), 2.0 * math.sin(bearing)
            command = Velocity(speed, turn, side)
        verdict = guard.step(parameters, limits, state, command, 0.0, seen, dt, measured)
        state = verdict.velocity
        for _ in range(round(dt / 0.01)):
            here = wheels.follow(state).compose(Pose(limits.centre, 0.0, 0.0))
            assert seen_from(here, obstacles).distance.min() >= allowed
