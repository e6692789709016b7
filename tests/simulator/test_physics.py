import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from maniple.core.geometry import Pose
from maniple.core.messages import Drive
from maniple.core.scenario.types import Box, Circle, Rates, RobotModel, Scenario, Wall
from simulator.physics import Physics
from tests.pioneer import PIONEER

MS = 1_000_000
T0 = 1_234_567_890_123_456_789
MakeScenario = Callable[..., Scenario]


def order(u: float, w: float, active: bool = True) -> Drive:
    return Drive(u_mps=u, w_radps=w, active=active)


def started(scenario: Scenario) -> Physics:
    physics = Physics(scenario)
    physics.start(T0)
    return physics


def drive(physics: Physics, u: float, w: float, start_ms: int, end_ms: int) -> None:
    """Tell the first robot the same every 50 ms."""
    for t in range(start_ms, end_ms, 50):
        physics.command(0, order(u, w), T0 + t * MS)
        physics.advance(T0 + (t + 50) * MS)


def test_lazy_steps_equal_a_timer_at_the_step_rate(make_scenario: MakeScenario) -> None:
    poses = [(0.0, 0.0, 0.1), (-1.0, 1.0, 0.0), (-1.0, -1.0, 3.0)]
    obstacles = [Circle(centre=(1.2, 0.3), radius_m=0.2), Wall(start=(-3.0, 2.0), end=(3.0, 2.0))]
    lazy, eager = (started(make_scenario(poses, obstacles)) for _ in range(2))
    random = np.random.default_rng(3)
    events = sorted(
        (int(t), int(robot))
        for t, robot in zip(random.integers(0, 4000, 240), random.integers(0, 3, 240), strict=True)
    )
    tick = 0
    for n, (t, robot) in enumerate(events):
        message = order(
            float(random.normal(0, 0.4)), float(random.normal(0, 1.0)), bool(random.random() < 0.95)
        )
        while tick + 10 <= t:
            tick += 10
            eager.advance(T0 + tick * MS)
        for physics in (lazy, eager):
            physics.command(robot, message, T0 + t * MS)
        if n % 7 == 0:
            lazy.advance(T0 + t * MS)
            assert lazy.poses() == pytest.approx(eager.poses(), abs=1e-12)
            assert lazy.ticks() == eager.ticks()
    lazy.advance(T0 + 6000 * MS)
    while tick < 6000:
        tick += 10
        eager.advance(T0 + tick * MS)
    assert lazy.poses() == pytest.approx(eager.poses(), abs=1e-12)
    assert lazy.contacts()[1:] == eager.contacts()[1:]
    assert (lazy.velocities() == 0).all()


def test_a_robot_drives_as_told(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(1.0, 2.0, 0.5)]))
    drive(physics, 0.3, 0.4, 0, 5000)
    u, w = physics.velocities()[0]
    assert u == pytest.approx(0.3 / 0.9965, abs=1e-3)
    assert w == pytest.approx(0.4 / 1.0768, abs=1e-3)
    before = Pose(*physics.poses()[0])
    drive(physics, 0.3, 0.4, 5000, 6000)
    after = before.advance(u, w)
    assert tuple(physics.poses()[0]) == pytest.approx(tuple(after), abs=1e-4)
    assert physics.drives() == [((0.3, 0.4, 0.0), "active")]


def test_a_drive_that_is_not_active_does_nothing(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0)]))
    physics.command(0, order(0.5, 0.5, active=False), T0)
    physics.advance(T0 + 1000 * MS)
    assert physics.poses()[0].tolist() == [0.0, 0.0, 0.0]
    assert physics.drives() == [((0.0, 0.0, 0.0), "configured")]


def test_silence_brakes_at_a_constant_rate_until_it_stands(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0)]))
    drive(physics, 0.6, 1.0, 0, 3000)
    heard = 2950
    physics.advance(T0 + (heard + 490) * MS)
    u, w = physics.velocities()[0]
    physics.advance(T0 + (heard + 690) * MS)
    assert physics.velocities()[0] == pytest.approx([u - 0.6 * 0.2, w - 1.745 * 0.2], abs=1e-3)
    assert physics.drives()[0][0] == (*physics.velocities()[0], 0.0)
    physics.advance(T0 + (heard + 500 + 1050) * MS)
    assert physics.velocities()[0].tolist() == [0.0, 0.0]
    assert physics.drives() == [((0.0, 0.0, 0.0), "active")]
    physics.command(0, order(-0.2, 0.0), T0 + 6000 * MS)
    physics.advance(T0 + 6100 * MS)
    assert physics.velocities()[0][0] < -0.02


def test_deactivation_brakes(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0)]))
    drive(physics, -0.3, -0.5, 0, 2000)
    physics.command(0, order(0.0, 0.0, active=False), T0 + 2000 * MS)
    physics.advance(T0 + 2100 * MS)
    assert -0.3 < physics.velocities()[0][0] < -0.2
    assert physics.drives()[0][1] == "configured"
    physics.advance(T0 + 2600 * MS)
    assert physics.velocities()[0].tolist() == [0.0, 0.0]


def test_after_a_long_freeze_the_robot_stands_where_it_braked(make_scenario: MakeScenario) -> None:
    frozen, awake = (started(make_scenario([(0.0, 0.0, 0.0)])) for _ in range(2))
    for physics in (frozen, awake):
        drive(physics, 0.5, 0.1, 0, 2000)
    for t in range(2010, 5000, 10):
        awake.advance(T0 + t * MS)
    day = 86_400_000
    frozen.advance(T0 + day * MS)
    assert frozen.poses() == pytest.approx(awake.poses(), abs=1e-12)
    frozen.command(0, order(0.5, 0.0), T0 + (day + 3) * MS)
    frozen.advance(T0 + (day + 1003) * MS)
    assert np.hypot(*(frozen.poses() - awake.poses())[0, :2]) > 0.1


def test_an_order_before_a_freeze_is_obeyed_in_it(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0)]))
    physics.advance(T0 + 10_000 * MS)
    physics.command(0, order(0.5, 0.0), T0 + 10_001 * MS)
    physics.advance(T0 + 3_600_000 * MS)
    assert physics.poses()[0, 0] == pytest.approx(0.5 * (0.5 - 0.26) + 0.43**2 / 1.2, abs=0.05)
    assert (physics.velocities() == 0.0).all()


@pytest.mark.parametrize(
    "obstacle",
    [
        Circle(centre=(1.5, 0.05), radius_m=0.2),
        Box(centre=(1.6, 0.1), size=(0.6, 0.5), angle_rad=0.3),
        Wall(start=(1.3, -1.0), end=(1.3, 1.0)),
    ],
)
def test_contact_stops_the_robot_which_may_move_away(
    make_scenario: MakeScenario, obstacle: Circle | Box | Wall
) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0)], [obstacle]))
    drive(physics, 0.5, 0.0, 0, 5000)
    clearances, collisions, contacts = physics.contacts()
    assert (clearances[0], collisions, contacts) == (0.0, 1, ("r1|obstacle 0",))
    x = physics.poses()[0, 0]
    assert 0.7 < x < 1.1
    drive(physics, 0.5, 0.0, 5000, 6000)
    assert physics.poses()[0, 0] - x < 0.001
    drive(physics, -0.5, 0.0, 6000, 8000)
    physics.contacts()
    clearances, collisions, contacts = physics.contacts()
    assert physics.poses()[0, 0] < x - 0.5
    assert collisions == 1
    assert contacts == ()
    assert clearances[0] > 0.5


def test_two_robots_that_meet_both_stop_and_count_once(make_scenario: MakeScenario) -> None:
    physics = started(make_scenario([(0.0, 0.0, 0.0), (1.5, 0.0, math.pi), (0.0, 3.0, 0.0)]))
    for t in range(0, 4000, 50):
        for robot in range(3):
            physics.command(robot, order(0.4, 0.0), T0 + t * MS)
        physics.advance(T0 + (t + 50) * MS)
    clearances, collisions, contacts = physics.contacts()
    assert (collisions, contacts) == (1, ("r1|r2",))
    assert clearances[:2].tolist() == [0.0, 0.0]
    assert clearances[2] > 2.0
    gap = physics.poses()[1, 0] - physics.poses()[0, 0] - 0.511
    assert 0 < gap < 0.01
    assert physics.poses()[2, 0] > 1.3


def test_a_contact_does_not_hold_up_the_others(make_scenario: MakeScenario) -> None:
    """Who is not touched moves exactly as if nobody had touched."""
    poses = [(0.0, 0.0, 0.0), (0.0, 3.0, 0.0)]
    hindered = started(make_scenario(poses, [Circle(centre=(0.8, 0.0), radius_m=0.2)]))
    free = started(make_scenario(poses))
    for t in range(0, 3000, 50):
        for physics in (hindered, free):
            for robot in range(2):
                physics.command(robot, order(0.4, 0.3), T0 + t * MS)
            physics.advance(T0 + (t + 50) * MS)
    assert hindered.contacts()[1] == 1
    assert hindered.poses()[1] == pytest.approx(free.poses()[1], abs=1e-12)


def test_slow_physics_still_stops_at_contact(make_scenario: MakeScenario) -> None:
    scenario = make_scenario([(0.0, 0.0, 0.0)], [Wall(start=(1.3, -1.0), end=(1.3, 1.0))])
    scenario = msgspec.structs.replace(scenario, rates=Rates(physics_hz=4.0))
    physics = started(scenario)
    drive(physics, 0.7, 0.0, 0, 5000)
    assert physics.contacts()[1:] == (1, ("r1|obstacle 0",))
    assert 0.8 < physics.poses()[0, 0] < 1.3 - 0.2555


ROUND = replace(PIONEER, drive="omnidirectional", v_max_mps=0.5)
CAR = replace(PIONEER, drive="car", wheelbase_m=0.5, steer_max_rad=0.4, body_offset_m=0.2)


def of_kind(scenario: Scenario, *kinds: RobotModel) -> Scenario:
    models = {f"kind{k}": kind for k, kind in enumerate(kinds)}
    robots = tuple(replace(robot, model=name) for robot, name in zip(scenario.robots, models, strict=True))
    return replace(scenario, robots=robots, models=models)


def test_a_robot_that_can_drives_sideways_and_the_others_as_before(make_scenario: MakeScenario) -> None:
    poses = [(0.0, 0.0, 0.5), (0.0, 3.0, 0.5)]
    plain = started(make_scenario(poses))
    mixed = started(of_kind(make_scenario(poses), PIONEER, ROUND))
    for t in range(0, 5000, 50):
        for physics in (plain, mixed):
            for robot in range(2):
                told = Drive(u_mps=0.2, w_radps=0.1, v_mps=0.3, active=True)
                physics.command(robot, told, T0 + t * MS)
            physics.advance(T0 + (t + 50) * MS)
    assert mixed.poses()[0] == pytest.approx(plain.poses()[0], abs=1e-12)
    assert plain.sideways() is None
    sideways = mixed.sideways()
    assert sideways is not None
    assert sideways == pytest.approx([0.0, 0.3 / 0.9965], abs=1e-3)
    assert [len(ticks) for ticks in mixed.ticks()] == [2, 3]
    assert mixed.drives()[1] == ((0.2, 0.1, 0.3), "active")
    before = Pose(*mixed.poses()[1])
    u, w = mixed.velocities()[1]
    mixed.advance(T0 + 5050 * MS)
    after = before.advance(0.05 * u, 0.05 * w, 0.05 * sideways[1])
    assert tuple(mixed.poses()[1]) == pytest.approx(tuple(after), abs=1e-5)
    mixed.advance(T0 + 9000 * MS)
    left = mixed.sideways()
    assert left is not None
    assert (left == 0.0).all()


def test_a_car_does_not_turn_on_the_spot_nor_tighter_than_it_can(make_scenario: MakeScenario) -> None:
    physics = started(of_kind(make_scenario([(0.0, 0.0, 0.0)]), CAR))
    drive(physics, 0.0, 1.0, 0, 1000)
    assert physics.poses()[0].tolist() == [0.0, 0.0, 0.0]
    drive(physics, 0.3, 1.5, 1000, 9000)
    u, w = physics.velocities()[0]
    assert w / u == pytest.approx(math.tan(0.4) / 0.5, rel=0.08)  # its drive turns a little less than told
    assert w / u <= math.tan(0.4) / 0.5 + 1e-9
    for t in range(9000, 10_500, 10):  # and brakes along its arc
        physics.advance(T0 + t * MS)
        u, w = physics.velocities()[0]
        assert abs(w) <= math.tan(0.4) / 0.5 * abs(u) + 1e-9


def test_the_body_of_a_car_is_ahead_of_its_axle(make_scenario: MakeScenario) -> None:
    wall = Wall(start=(1.3, -1.0), end=(1.3, 1.0))
    physics = started(of_kind(make_scenario([(0.0, 0.0, 0.0)], [wall]), CAR))
    drive(physics, 0.5, 0.0, 0, 5000)
    assert physics.contacts()[1] == 1
    assert physics.poses()[0, 0] == pytest.approx(1.3 - 0.2555 - 0.2, abs=0.01)
    assert physics.centres()[0].real - physics.poses()[0, 0] == pytest.approx(0.2)
    turned = started(of_kind(make_scenario([(0.0, 0.0, math.pi / 2)], [wall]), CAR))
    assert turned.contacts()[0][0] == pytest.approx(1.3 - 0.2125)


def test_slip_changes_what_encoders_count_and_not_the_motion(make_scenario: MakeScenario) -> None:
    slippery = replace(PIONEER, slip_sigma=0.1)
    runs = [
        started(of_kind(make_scenario([(0.0, 0.0, 0.0)]), kind)) for kind in (PIONEER, slippery, slippery)
    ]
    for physics in runs:
        drive(physics, 0.4, 0.2, 0, 4000)
    sound, first, second = runs
    assert (first.poses() == sound.poses()).all()
    assert first.ticks() == second.ticks() != sound.ticks()
    wheels = np.array(first.ticks()) / np.array(sound.ticks())
    assert wheels == pytest.approx(1.0, abs=0.1)
