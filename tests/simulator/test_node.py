import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from maniple.cli.loading import range_finders
from maniple.control.returns import returns_of
from maniple.core import codec, topics
from maniple.core.messages import Drive, ExternalPose, Motion, Scan, Truth, unpack_floats
from maniple.core.node import Node, Outgoing, Received
from maniple.core.scenario.types import Circle, Mavlink, RangeFinder, Rates, Scenario
from simulator.node import Simulator
from tests.pioneer import PIONEER

MS = 1_000_000
T0 = 10**18
POSES = [(0.0, 0.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0)]
MakeScenario = Callable[..., Scenario]


def run(simulator: Node, duration_ms: int, u: float = 0.1, w: float = 0.05) -> list[Outgoing]:
    """Everything that is sent while all robots are told (u, w) every 50 ms."""
    sent = list(simulator.on_start(T0))
    for t in range(0, duration_ms, 50):
        for topic in sorted(simulator.subscriptions - {topics.HOST_REFUSED}):
            message = Drive(u_mps=u, w_radps=w, active=True)
            sent += simulator.on_message(Received(topic, message), T0 + (t + 1) * MS)
        sent += simulator.on_timer("motion", T0 + (t + 13) * MS)
        if t % 100 == 0:
            sent += simulator.on_timer("scan", T0 + (t + 27) * MS)
        sent += simulator.on_timer("truth", T0 + (t + 38) * MS)
    return sent + list(simulator.on_stop(T0 + duration_ms * MS))


def last(sent: list[Outgoing], topic: str) -> object:
    return [message for name, message in sent if name == topic][-1]


def test_who_it_is_and_what_it_hears(make_scenario: MakeScenario) -> None:
    rates = Rates(motion_hz=20.0, scan_hz=10.0, truth_hz=5.0)
    simulator: Node = Simulator(make_scenario(POSES, rates=rates))
    assert simulator.name == "simulator"
    assert simulator.subscriptions == {"hw/r1/drive", "hw/r2/drive", "hw/r3/drive", topics.HOST_REFUSED}
    assert simulator.timers == {"motion": 50 * MS, "scan": 100 * MS, "truth": 200 * MS}


def test_everything_it_sends_is_a_valid_message(make_scenario: MakeScenario) -> None:
    sent = run(Simulator(make_scenario(POSES, [Circle(centre=(2.0, 0.0), radius_m=0.3)])), 1000)
    for name, message in sent:
        assert codec.decode(name, codec.encode(message)) == message
    names = [name for name, _ in sent]
    assert [names.count(topics.motion(r)) for r in ("r1", "r2", "r3")] == [20, 20, 20]
    assert [names.count(topics.scan(r)) for r in ("r1", "r2", "r3")] == [10, 10, 10]
    assert names.count(topics.TRUTH) == 21


def test_motion_truth_and_scan_tell_the_same_story(make_scenario: MakeScenario) -> None:
    obstacle = Circle(centre=(2.0, 0.3), radius_m=0.3)
    sent = run(Simulator(make_scenario(POSES, [obstacle])), 3000, w=0.0)
    truth = last(sent, topics.TRUTH)
    assert isinstance(truth, Truth)
    assert truth.robots == ("r1", "r2", "r3")
    poses = unpack_floats(truth.poses, 3)
    assert poses[0] == pytest.approx([0.27, 0.0, 0.0], abs=0.03)
    assert unpack_floats(truth.velocities, 2)[:, 0] == pytest.approx(0.1 / 0.9965, abs=1e-4)
    assert (truth.collisions, truth.contacts) == (0, ())
    to_neighbour = math.hypot(1.0 - 0.511, 1.0 - 0.425)
    assert unpack_floats(truth.clearances) == pytest.approx(to_neighbour, abs=1e-3)

    motion = last(sent, topics.motion("r1"))
    assert isinstance(motion, Motion)
    assert (motion.applied, motion.state, motion.controllable, motion.reason) == (
        (0.1, 0.0),
        "active",
        True,
        "",
    )
    metres = np.array(motion.ticks) * 2 * math.pi * 0.0975 / 78414
    assert metres == pytest.approx(poses[0, 0] - 0.003, abs=2e-3)

    scan = last(sent, topics.scan("r1"))
    assert isinstance(scan, Scan)
    assert scan.mount == (0.018, 0.0, 0.0)
    bearing = math.atan2(0.3, 2.0 - 0.28)
    reading = unpack_floats(scan.ranges)[90 + round(math.degrees(bearing))]
    assert reading == pytest.approx(math.hypot(2.0 - 0.28, 0.3) - 0.3, abs=0.05)


def test_same_seed_same_bytes_other_seed_other_noise(make_scenario: MakeScenario) -> None:
    scenario = make_scenario(POSES, [Circle(centre=(2.0, 0.3), radius_m=0.3)])
    first, second = (run(Simulator(scenario), 1000) for _ in range(2))
    assert first == second
    other = run(Simulator(msgspec.structs.replace(scenario, seed=2)), 1000)
    assert [o for o in other if "scan" in o.topic] != [o for o in first if "scan" in o.topic]
    assert [o for o in other if "scan" not in o.topic] == [o for o in first if "scan" not in o.topic]


def test_sensors_of_several_types_are_sent_in_the_order_of_the_robots(make_scenario: MakeScenario) -> None:
    scenario = make_scenario(POSES)
    short = RangeFinder(beams=60, first_angle_rad=0.0, increment_rad=0.1, range_max_m=4.1)
    robots = scenario.robots
    mixed = (robots[0], msgspec.structs.replace(robots[1], sensor="sonar"), robots[2])
    scenario = msgspec.structs.replace(scenario, robots=mixed, sensors={**scenario.sensors, "sonar": short})
    simulator = Simulator(scenario)
    simulator.on_start(T0)
    sent = simulator.on_timer("scan", T0 + 5 * MS)
    assert [o.topic for o in sent] == ["hw/r1/scan", "hw/r2/scan", "hw/r3/scan"]
    messages = [o.message for o in sent]
    assert all(isinstance(m, Scan) for m in messages)
    sonar = messages[1]
    assert isinstance(sonar, Scan)
    ranges = unpack_floats(sonar.ranges)
    assert len(ranges) == 60
    assert (ranges >= sonar.range_max_m).any()
    assert (ranges < sonar.range_max_m).any()


def test_a_foreign_kind_of_message_is_ignored(make_scenario: MakeScenario) -> None:
    simulator = Simulator(make_scenario(POSES))
    simulator.on_start(T0)
    odd = Motion(ticks=(1, 2), applied=(0.0, 0.0), state="active", controllable=True)
    assert list(simulator.on_message(Received("hw/r1/drive", odd), T0)) == []


def test_an_array_of_sonars_says_where_its_cones_are_and_sees_what_is_in_them(
    make_scenario: MakeScenario,
) -> None:
    ring = range_finders()["pioneer-3dx-sonar"]
    quiet = msgspec.structs.replace(ring, sigma_m=0.0)
    ahead = Circle(centre=(1.5, 0.1), radius_m=0.2)
    scenario = make_scenario([(0.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, -3.0, 0.0)], [ahead])
    robots = tuple(msgspec.structs.replace(robot, sensor="sonar") for robot in scenario.robots)
    scenario = msgspec.structs.replace(scenario, robots=robots, sensors={"sonar": quiet})
    simulator = Simulator(scenario)
    simulator.on_start(T0)
    scan, other, _ = (o.message for o in simulator.on_timer("scan", T0 + 5 * MS))
    assert isinstance(scan, Scan)
    assert isinstance(other, Scan)
    assert scan.mount == (0.0, 0.0, 0.0)
    assert scan.cone_rad == ring.cone_rad
    assert unpack_floats(scan.beams, 3) == pytest.approx(np.array(ring.transducers), abs=1e-6)
    ranges = unpack_floats(scan.ranges)
    x, y, _ = ring.transducers[4]
    assert ranges[4] == pytest.approx(math.hypot(1.5 - x, 0.1 - y) - 0.2, abs=2e-3)
    assert (ranges[[0, 1, 6, 7]] > 2.0).all()
    sides = 3.0 - 0.136 - 0.2125  # to the sides of its neighbours
    assert ranges[[0, 7]] == pytest.approx(sides, abs=2e-3)
    assert unpack_floats(other.ranges)[0] == pytest.approx(sides, abs=2e-3)
    assert returns_of(scan).sees_ahead


def test_truth_has_sideways_speeds_where_some_robot_can(make_scenario: MakeScenario) -> None:
    scenario = make_scenario(POSES)
    models = {"pioneer": msgspec.structs.replace(PIONEER, drive="omnidirectional", v_max_mps=0.5)}
    scenario = msgspec.structs.replace(scenario, models=models)
    simulator = Simulator(scenario)
    simulator.on_start(T0)
    for t in range(0, 1000, 50):
        order = Drive(u_mps=0.0, w_radps=0.0, v_mps=0.2, active=True)
        simulator.on_message(Received("hw/r1/drive", order), T0 + t * MS)
        motion = simulator.on_timer("motion", T0 + (t + 20) * MS)[0].message
    assert isinstance(motion, Motion)
    assert (len(motion.ticks), motion.applied, motion.applied_v_mps) == (3, (0.0, 0.0), 0.2)
    truth = simulator.on_timer("truth", T0 + 1000 * MS)[0].message
    assert isinstance(truth, Truth)
    v = 0.2 / 0.9965 * (1 - math.exp(-0.99 * 0.9965 / 0.2604))
    assert unpack_floats(truth.sideways) == pytest.approx([v, 0.0, 0.0], abs=1e-3)
    assert unpack_floats(truth.poses, 3)[0, 1] > 0.1


def changed(scenario: Scenario, robot: int, **changes: object) -> Scenario:
    """The scenario with one robot changed."""
    robots = list(scenario.robots)
    robots[robot] = msgspec.structs.replace(robots[robot], **changes)
    return msgspec.structs.replace(scenario, robots=tuple(robots))


def test_a_presented_robot_is_driven_by_its_vehicle_and_tells_it_its_pose(
    make_scenario: MakeScenario,
) -> None:
    scenario = changed(make_scenario(POSES), 1, driver="mavlink", presents="mavlink")
    simulator = Simulator(scenario)
    assert simulator.subscriptions == {"hw/r1/drive", "sim/r2/drive", "hw/r3/drive", topics.HOST_REFUSED}
    sent = run(simulator, 2000, w=0.3)
    assert {name for name, _ in sent} == {
        *("hw/r1/motion", "hw/r1/scan", "hw/r3/motion", "hw/r3/scan"),
        *("sim/r2/motion", "sim/r2/scan", topics.TRUTH),
    }
    own, shown = last(sent, "hw/r1/motion"), last(sent, "sim/r2/motion")
    assert isinstance(own, Motion)
    assert isinstance(shown, Motion)
    assert own.pose is None
    assert shown.pose is not None
    assert shown.ticks == own.ticks  # it is driven alike
    truth = [m for name, m in sent if name == topics.TRUTH][-3]  # that of 25 ms after the last motion but one
    before = [m for name, m in sent if name == "sim/r2/motion"][-2]
    assert isinstance(truth, Truth)
    assert isinstance(before, Motion)
    assert before.pose == pytest.approx(unpack_floats(truth.poses, 3)[1], abs=0.01)
    assert before.twist == pytest.approx((*unpack_floats(truth.velocities, 2)[1], 0.0), abs=0.01)


def test_presenting_one_robot_changes_nothing_for_the_others(make_scenario: MakeScenario) -> None:
    scenario = make_scenario(POSES, [Circle(centre=(2.0, 0.3), radius_m=0.3)])
    plain = run(Simulator(scenario), 1000)
    shown = run(Simulator(changed(scenario, 1, driver="mavlink", presents="mavlink")), 1000)
    for topic in ("hw/r1/motion", "hw/r1/scan", "hw/r3/motion", "hw/r3/scan", topics.TRUTH):
        assert [o for o in shown if o.topic == topic] == [o for o in plain if o.topic == topic]
    assert [o.message for o in shown if o.topic == "sim/r2/scan"] == [
        o.message for o in plain if o.topic == "hw/r2/scan"
    ]


def test_robots_without_a_body_are_not_there(make_scenario: MakeScenario) -> None:
    scenario = make_scenario(POSES)
    simulator = Simulator(changed(scenario, 1, driver="mavlink"))
    assert simulator.subscriptions == {"hw/r1/drive", "hw/r3/drive", topics.HOST_REFUSED}
    sent = run(simulator, 1000)
    assert not [name for name, _ in sent if "r2" in name]
    truth = last(sent, topics.TRUTH)
    assert isinstance(truth, Truth)
    assert truth.robots == ("r1", "r3")
    alike = run(Simulator(scenario), 1000)  # the places of the others do not matter to its noise
    scans = [o.message for o in sent if o.topic == "hw/r1/scan"]
    assert len(scans) == len([o for o in alike if o.topic == "hw/r1/scan"])


@pytest.mark.parametrize(
    ("changes", "topic"),
    [
        ({"driver": "mavlink", "presents": "mavlink", "scans": "simulator"}, "hw/r2/scan"),
        ({"driver": "mavlink", "presents": "mavlink", "scans": "ros2"}, "sim/r2/scan"),
        ({"scans": "ros2"}, ""),
        ({"scans": "simulator"}, "hw/r2/scan"),
    ],
)
def test_who_brings_the_scans_of_a_robot(
    make_scenario: MakeScenario, changes: dict[str, str], topic: str
) -> None:
    sent = run(Simulator(changed(make_scenario(POSES), 1, **changes)), 200)
    scans = {name for name, message in sent if isinstance(message, Scan)}
    assert scans - {"hw/r1/scan", "hw/r3/scan"} == ({topic} - {""})


def test_a_vehicle_without_a_position_of_its_own_is_seen_from_outside(make_scenario: MakeScenario) -> None:
    needy = Mavlink(external_pose=True)
    scenario = changed(make_scenario(POSES), 1, driver="mavlink", presents="mavlink", mavlink=needy)
    simulator = Simulator(scenario)
    assert simulator.timers["pose"] == 100 * MS
    simulator.on_start(T0)
    seen = [o for t in range(400) for o in simulator.on_timer("pose", T0 + t * 100 * MS)]
    assert {o.topic for o in seen} == {"hw/r2/pose"}
    poses = [o.message.pose for o in seen if isinstance(o.message, ExternalPose)]
    errors = np.array(poses) - POSES[1]
    assert errors.mean(axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=0.004)
    assert errors.std(axis=0) == pytest.approx([0.02, 0.02, 0.02], rel=0.15)
    for name, message in seen[:3]:
        assert codec.decode(name, codec.encode(message)) == message
    assert "pose" not in Simulator(make_scenario(POSES)).timers
