"""The suite passes a driver that keeps everything, and finds what each broken one does."""

import math
import threading
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

import pytest

from maniple.control.limits import Velocity
from maniple.core.errors import ManipleError
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan, pack_floats
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import SECOND, Duration, Time, period, to_seconds
from robot_agent.drivers.conformance import PROPERTIES, Act, WallRig, check, look
from robot_agent.drivers.interface import LIFE_CYCLE, Capabilities, Step

ALWAYS = (
    "every report is sound",
    "its states follow the life cycle",
    "what it applies is within what it can do",
    "no call blocks",
)
ABLE = Capabilities(0.6, 1.0, True, True, 20.0, 10.0, "r1")
SCAN = Scan(
    first_angle_rad=0.0,
    increment_rad=0.1,
    range_min_m=0.0,
    range_max_m=8.0,
    mount=(0.0, 0.0, 0.0),
    ranges=pack_floats([8.0] * 3),
)


class Cart:
    """A vehicle with a lag of 0.3 s and a pilot; without orders it stands by itself after 3 s."""

    acts: Collection[Act] = ("cut", "restore", "take", "give")

    def __init__(self, timeout_s: float = 3.0) -> None:
        self._now: Time = SECOND
        self._timeout_s = timeout_s
        self._order, self._ordered = Velocity(), self._now
        self.pose, self.moves = Pose(0.0, 0.0, 0.0), Velocity()
        self.linked, self.piloted = True, False

    def now(self) -> Time:
        return self._now

    def wait(self, duration: Duration) -> None:
        dt = to_seconds(duration)
        self._now += duration
        silent = to_seconds(self._now - self._ordered) > self._timeout_s
        wanted = Velocity() if silent or self.piloted else self._order
        pairs = zip(self.moves, wanted, strict=True)
        self.moves = Velocity(*(moves + dt / 0.3 * (order - moves) for moves, order in pairs))
        self.pose = self.pose.advance(self.moves.u * dt, self.moves.w * dt, self.moves.v * dt)

    def act(self, act: Act) -> None:
        if act in ("cut", "restore"):
            self.linked = act == "restore"
        else:
            self.piloted = act == "take"

    def velocity(self) -> Velocity | None:
        return self.moves

    def taken(self) -> bool:
        return self.piloted

    def drive(self, velocity: Velocity) -> None:
        """What comes over the link."""
        if self.linked and not self.piloted:
            self._order, self._ordered = velocity, self._now


class Good:
    """The driver of a cart."""

    capabilities = ABLE

    def __init__(self, cart: Cart) -> None:
        self.cart = cart
        self.state: DriverState = "closed"
        self.reason = ""
        self.heard = self.said = 0

    def take(self, step: Step, now: Time) -> None:
        if step == "fail" or (self.state, step) not in LIFE_CYCLE:
            raise ManipleError(f"it can't {step} while it is {self.state}")
        if step == "connect" and not self.cart.linked:
            self.reason = "nobody answers"
            return
        self.reason, self.heard = "", now
        if self.state == "active" and step != "activate":
            self.stop(now)
        self.state = LIFE_CYCLE[self.state, step]

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        if self.state in ("closed", "fault"):
            return []
        if not self.cart.linked:
            if now - self.heard > SECOND:
                self.state, self.reason = "fault", "not heard for 1 s"
            return []
        self.heard = now
        if now - self.said < period(self.capabilities.motion_hz):
            return []
        self.said = now
        reports: list[Motion | Scan] = [self.motion()]
        return [*reports, SCAN] if self.cart.now() // (SECOND // 20) % 2 else reports

    def motion(self, **changes: Any) -> Motion:
        piloted = self.cart.piloted
        values: dict[str, Any] = {
            "ticks": (),
            "applied": (0.0, 0.0),
            "state": self.state,
            "controllable": not piloted,
            "reason": "a pilot has it" if piloted else "",
            "pose": tuple(self.cart.pose),
            "twist": tuple(self.cart.moves),
        }
        return Motion(**values | changes)

    def write(self, drive: Drive, now: Time) -> Velocity:
        if self.state != "active":
            return Velocity()
        able = self.capabilities
        lowest = -able.u_max_mps if able.reverse else 0.0
        told = Velocity(
            min(max(drive.u_mps, lowest), able.u_max_mps),
            min(max(drive.w_radps, -able.w_max_radps), able.w_max_radps),
            min(max(drive.v_mps, -able.v_max_mps), able.v_max_mps),
        )
        self.pass_on(told)
        return told

    def pass_on(self, velocity: Velocity) -> None:
        self.cart.drive(velocity)

    def see(self, pose: ExternalPose, now: Time) -> None:
        pass

    def stop(self, now: Time) -> None:
        if self.state != "closed":
            self.cart.drive(Velocity())


def failures(made: type[Good], scenario: Scenario, *names: str, cart: Cart | None = None) -> dict[str, str]:
    """The counterexample of each property that does not hold, of some or of all."""
    rig = cart or Cart()
    chosen = [one for one in PROPERTIES if one.name in names]
    found = check(lambda *_: made(rig), scenario, "r1", rig, patience_s=3.0, properties=chosen)
    assert not [finding for finding in found if finding.left_out], found
    return {finding.name: finding.counterexample for finding in found if not finding.holds}


def test_a_good_driver_passes(make_scenario: Callable[..., Scenario]) -> None:
    rig = Cart()
    found = check(lambda *_: Good(rig), make_scenario(), "r1", rig)
    assert [finding for finding in found if not finding.holds] == []
    assert [finding.name for finding in found] == [*(one.name for one in PROPERTIES), *ALWAYS]


def test_every_name_is_there_once() -> None:
    assert len({one.name for one in PROPERTIES}) == len(PROPERTIES)


class Sideways(Good):
    capabilities = ABLE._replace(v_max_mps=0.4, reverse=False)


def test_one_that_goes_sideways_and_not_backwards_passes(make_scenario: Callable[..., Scenario]) -> None:
    driving = [one.name for one in PROPERTIES if "drives" in one.name]
    assert failures(Sideways, make_scenario(), *driving) == {}


class Counting(Good):
    """Reports counts of its wheels."""

    def motion(self, **changes: Any) -> Motion:
        if not hasattr(self, "wheels"):
            self.wheels = [0.0, 0.0]
            self.before = self.cart.now()
        u, w, _ = self.cart.moves
        dt = to_seconds(self.cart.now() - self.before)
        self.before = self.cart.now()
        ways = (u - w * self.half, u + w * self.half)
        self.wheels = [way + rate * dt for way, rate in zip(self.wheels, ways, strict=True)]
        ticks = tuple(round(way / self.metres_per_tick) for way in self.wheels)
        return super().motion(ticks=ticks, pose=None, twist=(0.0, 0.0, 0.0), **changes)

    half = metres_per_tick = 0.0


def test_counts_do_as_well_and_nobody_has_to_measure(make_scenario: Callable[..., Scenario]) -> None:
    scenario, rig = make_scenario(), Cart()
    model = scenario.models["pioneer-3dx"]
    Counting.half = 0.5 * model.track_m
    Counting.metres_per_tick = 2.0 * math.pi * model.wheel_radius_m / model.ticks_per_revolution
    rig.velocity = lambda: None  # type: ignore[method-assign]
    found = check(lambda *_: Counting(rig), scenario, "r1", rig)
    assert {finding.name: finding.left_out for finding in found if not finding.holds} == {
        "its poses go where its twists say": "it reports counts, of which the agent makes both",
        "stands when its link is cut on its way": "nobody measures how the vehicle moves",
    }


def test_without_moving_it_is_never_activated(make_scenario: Callable[..., Scenario]) -> None:
    rig, steps = Cart(), []

    class Watched(Good):
        def take(self, step: Step, now: Time) -> None:
            steps.append(step)
            super().take(step, now)

        def pass_on(self, velocity: Velocity) -> None:
            raise AssertionError("it is told something")

    found = check(lambda *_: Watched(rig), make_scenario(), "r1", rig, moves=False)
    assert [finding for finding in found if finding.counterexample] == []
    left_out = {finding.name for finding in found if finding.left_out}
    assert left_out == {one.name for one in PROPERTIES if one.moves}
    # It is told to activate only where it has to refuse that.
    assert Cart().moves == rig.moves
    assert "configure" in steps


class Laser(Good):
    """Brings scans only, ten a second."""

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return [report for report in super().read(now) if isinstance(report, Scan)]


def test_one_that_only_brings_scans_is_never_activated(make_scenario: Callable[..., Scenario]) -> None:
    rig = Cart()
    found = check(lambda *_: Laser(rig), make_scenario(), "r1", rig, scans_only=True)
    assert {finding.name for finding in found if not finding.holds} == {
        one.name for one in PROPERTIES if one.moves
    }
    assert {finding.left_out for finding in found if not finding.holds} == {"it only brings scans"}
    seen = look(lambda *_: Laser(rig), make_scenario(), "r1", rig, scans_only=True)
    assert (seen.state, seen.reason, seen.motion) == ("configured", "", None)
    assert seen.scan_hz == pytest.approx(10.0, rel=0.1)
    rig.linked = False
    seen = look(lambda *_: Laser(rig), make_scenario(), "r1", rig, scans_only=True, patience_s=2.0)
    assert (seen.state, seen.scan_hz) == ("closed", 0.0)
    assert seen.reason == "after 2 s it is closed, and should be configured: nobody answers"


def test_what_the_rig_can_not_do_is_left_out(make_scenario: Callable[..., Scenario]) -> None:
    rig = Cart()
    rig.acts = ("cut", "restore")
    found = check(lambda *_: Good(rig), make_scenario(), "r1", rig, properties=PROPERTIES[-1:])
    assert found[0].left_out == "nobody is there to give and take it"
    assert not found[0].holds


def test_a_rig_by_the_wall_clock() -> None:
    rig = WallRig()
    before = rig.now()
    rig.wait(SECOND // 100)
    assert rig.now() - before >= SECOND // 100
    assert not rig.taken()
    with pytest.raises(ManipleError, match="nobody is there to cut"):
        rig.act("cut")


# What can be wrong with a driver.


class Weak(Good):
    capabilities = ABLE._replace(u_max_mps=0.0, frame="odom")


class Changing(Good):
    @property
    def capabilities(self) -> Capabilities:  # type: ignore[override]
        return ABLE if self.state == "closed" else ABLE._replace(u_max_mps=1.0)


class Eager(Good):
    def __init__(self, cart: Cart) -> None:
        super().__init__(cart)
        threading.Thread(target=int).start()


class Stuck(Good):
    def take(self, step: Step, now: Time) -> None:
        if step == "configure":
            self.reason = "no EKF origin"
        else:
            super().take(step, now)


class Mute(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        super().read(now)
        return []


class Haunting(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return super().read(now) or ([self.motion()] if self.state == "closed" else [])


class Lax(Good):
    def take(self, step: Step, now: Time) -> None:
        if (self.state, step) in LIFE_CYCLE:
            super().take(step, now)


class Touchy(Good):
    def stop(self, now: Time) -> None:
        if self.state == "closed":
            raise OSError("not connected")
        super().stop(now)


class Quitting(Good):
    def see(self, pose: ExternalPose, now: Time) -> None:
        self.state = "fault"


class Slow(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return super().read(now) if now - self.said > SECOND // 3 else []


class Blind(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return [report for report in super().read(now) if isinstance(report, Motion)]


class Remembering(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return super().read(now) or ([SCAN] if self.state == "configured" and not self.cart.linked else [])


class Repeating(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        reports = super().read(now)
        if not reports and not self.cart.linked and self.state != "closed":
            return [self.motion(controllable=False, reason="not heard")]
        return reports


class Hopeful(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        reports = super().read(now)
        if not self.cart.linked and self.state != "closed":
            return [self.motion(pose=None)]
        return reports


class GivingUp(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        reports = super().read(now)
        self.over = getattr(self, "over", False) or self.state == "fault"
        return [] if self.over else reports

    def take(self, step: Step, now: Time) -> None:
        if not (getattr(self, "over", False) and step == "connect"):
            super().take(step, now)


class Early(Good):
    def write(self, drive: Drive, now: Time) -> Velocity:
        if self.state == "configured":
            self.pass_on(Velocity(drive.u_mps, drive.w_radps))
            return Velocity(drive.u_mps, drive.w_radps)
        return super().write(drive, now)


class Secret(Good):
    def write(self, drive: Drive, now: Time) -> Velocity:
        if self.state == "configured":
            self.pass_on(Velocity(drive.u_mps, drive.w_radps))
        return super().write(drive, now)


class Clockwise(Good):
    """As one that takes yaw, which counts clockwise, for psi."""

    def pass_on(self, velocity: Velocity) -> None:
        super().pass_on(velocity._replace(w=-velocity.w))


class Mirrored(Good):
    def motion(self, **changes: Any) -> Motion:
        u, w, v = self.cart.moves
        return super().motion(twist=(u, -w, v), **changes)


class NorthEast(Good):
    """Poses as in north, east and yaw."""

    def motion(self, **changes: Any) -> Motion:
        x, y, psi = self.cart.pose
        return super().motion(pose=(y, x, psi), **changes)


class Hasty(Good):
    """As one that takes knots for m/s."""

    def pass_on(self, velocity: Velocity) -> None:
        super().pass_on(velocity._replace(u=1.94 * velocity.u))


class Backwards(Good):
    capabilities = ABLE._replace(reverse=False)

    def pass_on(self, velocity: Velocity) -> None:
        super().pass_on(velocity._replace(u=-0.3) if velocity.w < 0.0 else velocity)


class Boasting(Good):
    def write(self, drive: Drive, now: Time) -> Velocity:
        u, w, v = super().write(drive, now)
        return Velocity(2.0 * u, w, v)


class Running(Good):
    """Says the last order again and again, by itself."""

    last = Velocity()

    def pass_on(self, velocity: Velocity) -> None:
        self.last = velocity

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        self.cart.drive(self.last)
        return super().read(now)

    def stop(self, now: Time) -> None:
        pass


class Clinging(Good):
    def take(self, step: Step, now: Time) -> None:
        if step != "deactivate":
            super().take(step, now)


class Deaf(Good):
    """Stops nothing, and heeds only who wants it active."""

    def write(self, drive: Drive, now: Time) -> Velocity:
        return super().write(drive, now) if drive.active else Velocity()

    def stop(self, now: Time) -> None:
        pass


class Fighting(Good):
    def pass_on(self, velocity: Velocity) -> None:
        self.cart.piloted = False
        super().pass_on(velocity)


class Ending(Good):
    """Takes it back when it is deactivated."""

    def stop(self, now: Time) -> None:
        self.cart.piloted = False
        super().stop(now)


class Ignorant(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(**{"controllable": True, "reason": ""} | changes)


class Sulking(Good):
    """Does not move again after a pilot had it."""

    def pass_on(self, velocity: Velocity) -> None:
        if not getattr(self, "sulks", False):
            super().pass_on(velocity)

    def motion(self, **changes: Any) -> Motion:
        self.sulks = getattr(self, "sulks", False) or self.cart.piloted
        return super().motion(**changes)


class NotANumber(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(pose=(math.nan, 0.0, 0.0), **changes)


class Infinite(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(applied=(math.inf, 0.0), **changes)


class Excusing(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(reason="all is well", **changes)


class Silent(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(controllable=False, **changes)


class Lying(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(state="active", **changes)


class Empty(Good):
    def motion(self, **changes: Any) -> Motion:
        return super().motion(pose=None, **changes)


class Talkative(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        return [*super().read(now), Drive(u_mps=0.0, w_radps=0.0, active=False)]  # type: ignore[list-item]


class Jumping(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        if self.state == "connected":
            self.state = "active"
        return super().read(now)


class Blocking(Good):
    slept = False

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        if not Blocking.slept:
            Blocking.slept = True
            time.sleep(0.35)
        return super().read(now)


class Raising(Good):
    def read(self, now: Time) -> Sequence[Motion | Scan]:
        raise ValueError("no such frame")


UP = "comes up and down step by step"
FLAWS: Sequence[tuple[type[Good], str, str]] = [
    (Weak, "says what it can do before it is connected", "u_max_mps = 0.0: must be positive; frame = 'odom'"),
    (Changing, "says what it can do before it is connected", "connected it says Capabilities(u_max_mps=1.0"),
    (Eager, "is made without any input or output", "it calls _thread.start_new_thread"),
    (Stuck, UP, "after 3 s it is connected, and should be configured: no EKF origin"),
    (Mute, UP, "after 3 s it is configured, but has not said how its vehicle moves: it has reported nothing"),
    (Haunting, UP, "closed it goes on reporting"),
    (Raising, UP, "raised ValueError: no such frame"),
    (Lax, "refuses steps that are not open", "while closed it takes the step configure"),
    (Touchy, "takes stop and poses from outside in any state", "stop while closed raised OSError"),
    (Quitting, "takes stop and poses from outside in any state", "see while closed left it fault"),
    (Slow, "reports as often as it promises", "motion: 2.7 /s; it promises 20"),
    (Blind, "reports as often as it promises", "scan: 0.0 /s; it promises 10"),
    (Repeating, "says nothing while its vehicle does", "more than 0.5 s after the cut it reports (0.0, 0.0"),
    (Remembering, "says nothing while its vehicle does", "more than 0.5 s after the cut it reports scans"),
    (Hopeful, "says nothing while its vehicle does", "after the cut it reports that it is controllable"),
    (GivingUp, "comes back when its vehicle does", "after 3 s it is closed, and should be configured: not "),
    (Early, "moves nothing before it is active", "and applies u = 0.300 m/s"),
    (Secret, "moves nothing before it is active", "while configured it moves: u = 0.2"),
    (Clockwise, "drives where it is told, and reports that", "w = 0.300 rad/s, the vehicle moves u = 0.300"),
    (Mirrored, "drives where it is told, and reports that", "it reports u = 0.300 m/s, w = -0.300 rad/s"),
    (NorthEast, "its poses go where its twists say", "by its poses it went ("),
    (Hasty, "never drives faster than it can", "told u = 0.600 m/s, w = 1.000 rad/s it moves u = 1.1"),
    (Backwards, "never drives faster than it can", "it drives backwards, and says that it can't"),
    (Running, "stands when it is stopped", "stopped it still moves after 2 s: u = 0.3"),
    (Deaf, "stands when it is stopped", "stopped it still moves after 2 s: u = 0.3"),
    (Deaf, "stands when it is deactivated and closed", "deactivated it still moves after 1 s: u = 0.3"),
    (Clinging, "stands when it is deactivated and closed", "6 s after deactivate it is active"),
    (
        Running,
        "stands when it is closed on its way",
        "closed while it drove it still moves after 6 s: u = 0.3",
    ),
    (Deaf, "stands when its agent falls silent", "without a word of its agent it still moves after 0 s: u ="),
    (Fighting, "tells who has it, does not fight, comes back", "it took it back from whoever had it"),
    (Ending, "tells who has it, does not fight, comes back", "it took it back from whoever had it"),
    (
        Ignorant,
        "tells who has it, does not fight, comes back",
        "it says that it is controllable while somebody",
    ),
    (
        Sulking,
        "tells who has it, does not fight, comes back",
        "told u = -0.300 m/s, w = 0.000 rad/s it stands",
    ),
    (NotANumber, "every report is sound", "pose (nan, 0.0, 0.0)"),
    (Infinite, "every report is sound", "hw/r1/motion: applied is not finite"),
    (Excusing, "every report is sound", "it is controllable, with the reason 'all is well'"),
    (Silent, "every report is sound", "it is not controllable and does not say why"),
    (Lying, "every report is sound", "it reports that it is active, and is connected"),
    (Empty, "every report is sound", "it is configured and controllable, and reports neither counts nor a"),
    (Talkative, "every report is sound", "it reports a Drive; must be a Motion or a Scan"),
    (Jumping, "its states follow the life cycle", "from connected it went to active; it was told to con"),
    (Boasting, "what it applies is within what it can do", "told u = 0.600 m/s, w = 1.000 rad/s it applies"),
    (Blocking, "no call blocks", "read took 0.3"),
]


@pytest.mark.parametrize(
    ("made", "name", "counterexample"), FLAWS, ids=[f"{made.__name__}-{name}" for made, name, _ in FLAWS]
)
def test_what_is_wrong_is_found(
    make_scenario: Callable[..., Scenario], made: type[Good], name: str, counterexample: str
) -> None:
    tried = {
        "what it applies is within what it can do": "never drives faster than it can",
        **dict.fromkeys(ALWAYS[:2], UP),
        ALWAYS[3]: UP,
    }
    assert counterexample in failures(made, make_scenario(), tried.get(name, name))[name]


def test_a_vehicle_that_drives_on_without_its_link_is_found(make_scenario: Callable[..., Scenario]) -> None:
    name = "stands when its link is cut on its way"
    found = failures(Good, make_scenario(), name, cart=Cart(timeout_s=60.0))
    assert found == {name: "with its link cut it still moves after 6 s: u = 0.300 m/s, w = 0.000 rad/s"}


def test_there_is_a_broken_driver_for_every_property() -> None:
    found = {name for _, name, _ in FLAWS} | {"stands when its link is cut on its way"}
    assert found == {one.name for one in PROPERTIES} | set(ALWAYS)


def test_a_failing_driver_leaves_no_vehicle_driving(make_scenario: Callable[..., Scenario]) -> None:
    rig = Cart()

    class Failing(Good):
        def read(self, now: Time) -> Sequence[Motion | Scan]:
            if rig.moves.u > 0.2:
                raise ValueError("out of range")
            return super().read(now)

    name = "stands when it is stopped"
    chosen = [one for one in PROPERTIES if one.name == name]
    found = check(lambda *_: Failing(rig), make_scenario(), "r1", rig, properties=chosen)
    assert found[0].counterexample == "raised ValueError: out of range"
    rig.wait(SECOND // 100)
    assert rig._order == Velocity()


def test_the_parameters_of_the_robot_are_its_factorys_affair(make_scenario: Callable[..., Scenario]) -> None:
    rig, asked = Cart(), list[tuple[str, str]]()

    def factory(scenario: Scenario, robot: Robot, endpoint: str = "") -> Good:
        asked.append((robot.id, endpoint))
        return Good(rig)

    check(factory, make_scenario(), "r1", rig, endpoint="tcp/h:1", properties=PROPERTIES[1:2])
    assert set(asked) == {("r1", "tcp/h:1")}
