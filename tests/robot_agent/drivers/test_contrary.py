"""Drives that take a sign the other way, with the agent that tells them what to do."""

import pytest
from msgspec.structs import replace

from maniple.control.limits import Velocity
from maniple.core import topics
from maniple.core.messages import Command, Drive, EmergencyStop, Message, Motion, Odometry, Stamp, Status
from maniple.core.node import Received
from maniple.core.time import MILLISECOND, SECOND, Time
from robot_agent.drivers.mavlink.vehicle import GUIDED, HOLD
from robot_agent.node import DRIVE, STATUS, RobotAgent
from tests.robot_agent.drivers.bench import Bench
from tests.robot_agent.drivers.mavlink.bench import Bench as Rover
from tests.robot_agent.hosted import SCENARIO

TICK = 50 * MILLISECOND


class Platoon:
    """The agent of r1 and a controller that wants `values` of it."""

    def __init__(self, values: tuple[float, float], now: Time) -> None:
        self.agent = RobotAgent(SCENARIO, "r1")
        self._values = values
        self._said = 0
        self.agent.on_start(now)

    def turn(self, motions: list[Motion], now: Time) -> Drive:
        """What its drive reported, and then what it is told."""
        for motion in motions:
            for _, message in self._hear(
                topics.motion("r1"), replace(motion, source="simulator", incarnation=1), now
            ):
                if isinstance(message, Odometry):
                    command = Command(
                        source="controller",
                        layer="drive",
                        values=self._values,
                        answers=Stamp(1, 0, now),
                        inputs_age_ns=0,
                    )
                    self._hear(topics.command("r1"), command, now)
        (drive,) = (one for _, one in self.agent.on_timer(DRIVE, now) if isinstance(one, Drive))
        return drive

    def order(self, stopped: bool, now: Time) -> None:
        self._said += 1
        said = EmergencyStop(source="operator", incarnation=1, seq=self._said, stopped=stopped)
        self._hear(topics.STOP, said, now)

    def status(self, now: Time) -> Status:
        ((_, status),) = self.agent.on_timer(STATUS, now)
        assert isinstance(status, Status)
        return status

    def _hear(self, topic: str, message: Message, now: Time) -> list[tuple[str, Message]]:
        return list(self.agent.on_message(Received(topic, message), now))


class Crossed(Bench):
    """A third party's driver that goes backwards where it is told forwards."""

    def write(self, drive: Drive, now: Time) -> Velocity:
        applied = super().write(drive, now)
        self.velocity = Velocity(-drive.u_mps, drive.w_radps)
        return applied


def test_a_driver_that_takes_the_sign_the_other_way_is_stopped_for_good() -> None:
    driver, now = Crossed(), 1000 * SECOND
    for step in ("connect", "configure", "activate"):
        driver.take(step, now)
    platoon, farthest = Platoon((0.3, 0.0), now), 0.0

    def run(seconds: float) -> Drive:
        nonlocal now, farthest
        for _ in range(round(seconds * SECOND / TICK)):
            now += TICK
            motions = [one for one in driver.read(now) if isinstance(one, Motion)]
            drive = platoon.turn(motions, now)
            driver.write(drive, now)
            for motion in motions:
                assert motion.pose is not None
                farthest = max(farthest, -motion.pose[0])
        return drive

    assert run(1.1).u_mps == pytest.approx(0.3)
    assert run(1.0).u_mps == 0.0
    assert "told to drive forwards for 1 s and moves backwards" in platoon.status(now).reason
    assert run(20.0).u_mps == 0.0
    assert (driver.velocity, platoon.status(now).mode) == (Velocity(), "fault")
    assert 0.2 < farthest < 0.4
    platoon.order(True, now)
    run(0.5)
    platoon.order(False, now)
    assert run(0.5).u_mps > 0.0
    assert run(1.0).u_mps == 0.0
    assert platoon.status(now).counters["contrary"] == 2


@pytest.mark.parametrize(
    ("wanted", "signs", "words"),
    [
        ((0.3, 0.0), (-1.0, 1.0), "told to drive forwards for 1 s and moves backwards"),
        ((0.2, 0.5), (1.0, -1.0), "told to turn left for 1 s and turns right"),
    ],
)
def test_a_rover_with_crossed_motors_is_put_into_hold(
    wanted: tuple[float, float], signs: tuple[float, float], words: str
) -> None:
    """A pilot that gives it back to GUIDED does not set it moving."""
    rover = Rover()
    rover.reach("active")
    platoon = Platoon(wanted, rover.now)

    def run(seconds: float) -> None:
        for _ in range(round(seconds * SECOND / TICK)):
            heard = len(rover.motions)
            rover.run(TICK / SECOND)
            rover.order = platoon.turn(rover.motions[heard:], rover.now)
            if not rover.order.active and rover.session.state == "active":
                rover.take("deactivate")

    run(3.0)
    assert platoon.status(rover.now).mode == "tracking"
    assert rover.velocity.u == pytest.approx(wanted[0], abs=0.02)
    rover.signs = signs
    run(2.0)
    status = platoon.status(rover.now)
    assert (status.mode, status.reason.split(" (")[0]) == ("fault", words)
    run(3.0)
    assert rover.rover.mode == HOLD
    assert rover.velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    rover.pilot_sets(GUIDED)
    run(3.0)
    assert platoon.status(rover.now).mode == "fault"
    assert rover.velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
