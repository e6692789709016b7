import math

import pytest
from msgspec.structs import replace

from maniple.control.limits import age_limits, aged, limits_of
from maniple.core.layers import Layer
from maniple.core.scenario.types import (
    Avoidance,
    Controller,
    Formation,
    Guard,
    Line,
    Placement,
    Robot,
    Scenario,
)
from tests.pioneer import PIONEER


def scenario(
    placement: Placement, controller: Controller, law: Guard, speed: float = 0.1, a: float = 0.3
) -> tuple[Scenario, Robot]:
    robot = Robot(id="r1", control_point_m=a)
    return Scenario(
        name="test",
        robots=(robot,),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=speed),
        placement=placement,
        controller=controller,
        guard=law,
        models={"pioneer-3dx": PIONEER},
    ), robot


@pytest.mark.parametrize("cut", ["drive", "compensation", "avoidance"])
def test_age_limits_with_the_kinematics_in_the_centre(cut: Layer) -> None:
    placement = Placement(robot_from=cut)
    hold, stop = age_limits(*scenario(placement, Controller(), Guard()))
    assert stop == pytest.approx(0.5 * math.pi * 3.0 - 0.2604 / 0.9965)
    assert hold == pytest.approx(0.5 * stop)
    faster = age_limits(*scenario(placement, Controller(saturation=0.2), Guard()))
    assert faster[1] == pytest.approx(0.5 * math.pi * 1.5 - 0.2604 / 0.9965)


def test_age_limits_with_the_kinematics_on_the_robot() -> None:
    gains = Controller(kappa=(0.1, 0.5, 9.0, 9.0, 9.0, 9.0))
    _, stop = age_limits(*scenario(Placement(robot_from="kinematics"), gains, Guard()))
    assert stop == pytest.approx(0.8 * math.pi / 1.0)


def test_age_limits_never_fall_below_what_a_control_period_takes() -> None:
    placement = Placement(robot_from="drive")
    _, stop = age_limits(*scenario(placement, Controller(), Guard(), speed=2.0, a=0.1))
    assert stop == pytest.approx(0.3)


def test_explicit_age_limits_win() -> None:
    placement = Placement(robot_from="drive")
    own = Guard(hold_after_s=0.7, stop_after_s=0.9)
    assert age_limits(*scenario(placement, Controller(), own)) == (0.7, 0.9)
    hold, stop = age_limits(*scenario(placement, Controller(), Guard(hold_after_s=99.0)))
    assert hold == stop
    assert age_limits(*scenario(placement, Controller(), Guard(stop_after_s=0.5))) == (0.25, 0.5)


def test_limits_of_a_robot_come_from_its_model() -> None:
    limits = limits_of(*scenario(Placement(robot_from="drive"), Controller(), Guard()))
    assert (limits.u_lag_s, limits.w_lag_s) == pytest.approx((0.2604 / 0.9965, 0.2509 / 1.0768))
    assert (limits.gain, limits.delay_s) == (1.0 / 0.9965, 0.1)
    assert limits.radius == pytest.approx(0.5 * math.hypot(0.511, 0.425))
    assert (limits.u_min, limits.u_max, limits.brake) == (-0.75, 0.75, 0.6)


def test_it_needs_ranges_if_its_guard_or_a_layer_of_its_own_goes_by_them() -> None:
    for clearance in (False, True):
        for cut in ("kinematics", "avoidance", "compensation", "drive"):
            for enabled in (False, True):
                made, robot = scenario(Placement(robot_from=cut), Controller(), Guard(clearance=clearance))
                limits = limits_of(replace(made, avoidance=Avoidance(enabled=enabled)), robot)
                onboard = enabled and cut in ("kinematics", "avoidance")
                assert limits.needs_ranges == (clearance or onboard)


def test_what_sideways_motion_and_steering_limit() -> None:
    scene, robot = scenario(Placement(), Controller(), Guard())
    kinds = {
        "omni": replace(PIONEER, drive="omnidirectional", v_max_mps=0.4),
        "car": replace(PIONEER, drive="car", wheelbase_m=0.5, steer_max_rad=0.4, body_offset_m=0.2),
        "lopsided": replace(PIONEER, body_offset_m=0.1),
    }
    scene = replace(scene, models=kinds)
    omni, car, lopsided = (limits_of(scene, replace(robot, model=name)) for name in kinds)
    assert (omni.v_max, omni.curvature, omni.centre, omni.swing) == (0.4, math.inf, 0.0, 0.0)
    assert car.v_max == 0.0
    assert car.curvature == pytest.approx(math.tan(0.4) / 0.5)
    assert (car.centre, car.radius) == (0.2, 0.5 * math.hypot(0.511, 0.425))
    assert math.tan(car.swing) == pytest.approx(0.2 * car.curvature)
    assert (lopsided.centre, lopsided.radius) == (0.0, math.hypot(0.5 * 0.511 + 0.1, 0.5 * 0.425))


def test_a_command_may_bear_less_age_than_the_robot_but_not_more() -> None:
    limits = limits_of(*scenario(Placement(), Controller(), Guard(hold_after_s=0.4, stop_after_s=2.0)))
    for own in (0.0, 2.0, 9.0):
        assert aged(limits, own) is limits
    less = aged(limits, 0.5)
    assert (less.hold_s, less.stop_s) == pytest.approx((0.1, 0.5))
