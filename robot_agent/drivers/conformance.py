"""What every driver has to keep, as checks that give the counterexample.

`check` runs a driver against its vehicle as the process beside an agent does: `read` every 10 ms, `write`
while something is ordered, one step of the life cycle after the other. What it needs of the vehicle besides
comes from a `Rig`: its time, and, where there is somebody or something to do it, a link that is cut, a pilot
who takes over, and how the vehicle really moves. Each check makes a driver of its own and leaves the vehicle
standing.
"""

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Literal, NamedTuple, NoReturn, Protocol, TypeAlias

from maniple.control.conformance import watched
from maniple.control.limits import Velocity, curvature_max
from maniple.core import codec, edges, topics
from maniple.core.errors import ManipleError, MessageError
from maniple.core.geometry import Pose, wrap
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import MILLISECOND, Duration, Time, from_seconds, to_seconds
from robot_agent import dead_reckoning
from robot_agent.dead_reckoning import Reckoning
from robot_agent.drivers.interface import LIFE_CYCLE, Answering, Capabilities, Driver, DriverFactory, Step
from robot_agent.drivers.keeper import STAND, WATCHDOG, ZEROS, Halt, Keeper, Take, clipped

PERIOD: Duration = 10 * MILLISECOND
"""Between two calls of a driver, as in its process."""

U_MPS, W_RADPS = 0.3, 0.3
"""The suite drives no faster than this, nor than half of what the robot can, but for a second where it asks
for too much."""

STILL_MPS, STILL_RADPS = 0.02, 0.03
"""What moves less stands."""

PATIENCE_S = 60.0
"""For a step of the life cycle, of a real vehicle that has to find out where it is."""

NOTICE_S = 2.0
"""So soon a driver has to tell that somebody else has its vehicle."""

FLIGHT_S = 0.5
"""What was under way when a link was cut may still arrive for so long."""

STAND_S = 6.0
"""So soon a vehicle has to stand by itself, a timeout of its own of 3 s included."""

BLOCKED_S = 0.3
"""No call may take as long as what the watchdog waits for."""

_LISTEN_S = 3.0
"""To measure rates."""

_AGAIN_S = 1.0
"""A step that is under way is asked for again after this."""

Act: TypeAlias = Literal["cut", "restore", "take", "give"]
"""What a rig may do to a vehicle: cut its link and restore it; let a pilot, or whoever else may, take it from
the driver and give it back."""


class Rig(Protocol):
    """A vehicle and what is around it, besides its driver."""

    @property
    def acts(self) -> Collection[Act]:
        """What it can do; checks that need more are left out."""
        ...

    def now(self) -> Time:
        """The time by which the driver lives (ns)."""
        ...

    def wait(self, duration: Duration) -> None:
        """Let time go on, and a simulated vehicle live in it. It may also just sleep."""
        ...

    def act(self, act: Act) -> None:
        """One of `acts`; it has happened when this returns."""
        ...

    def velocity(self) -> Velocity | None:
        """How the vehicle really moves now; None where nobody measures it: then its own reports count."""
        ...

    def taken(self) -> bool:
        """Whether whoever took it from the driver still has it."""
        ...


class WallRig:
    """A vehicle that is there, and nobody who could do anything to it."""

    acts: Collection[Act] = ()

    def now(self) -> Time:
        """By the monotonic clock."""
        return time.monotonic_ns()

    def wait(self, duration: Duration) -> None:
        """Sleep."""
        time.sleep(to_seconds(duration))

    def act(self, act: Act) -> NoReturn:
        """Nothing can be done to it."""
        raise ManipleError(f"nobody is there to {act}")

    def velocity(self) -> None:
        """Nobody measures it."""
        return

    def taken(self) -> bool:
        """Nobody takes it."""
        return False


class Finding(NamedTuple):
    """One property, and whether it holds."""

    name: str
    """The property."""
    counterexample: str = ""
    """Empty if none was found."""
    left_out: str = ""
    """Why it was not tried; empty if it was."""

    @property
    def holds(self) -> bool:
        """Whether it was tried and no counterexample was found."""
        return not (self.counterexample or self.left_out)


class CounterexampleError(Exception):
    """What a driver did that it must not."""


class LeftOutError(Exception):
    """Why a property can't be tried here."""


def check(
    factory: DriverFactory,
    scenario: Scenario,
    robot: str,
    rig: Rig,
    *,
    endpoint: str = "",
    moves: bool = True,
    patience_s: float = PATIENCE_S,
    scans_only: bool = False,
    properties: Sequence["Property"] = (),
    told: Callable[[Finding], None] = lambda _: None,
) -> list[Finding]:
    """The properties of a driver, all or some of `PROPERTIES`, tried with the vehicle of `robot` (its id) in
    a resolved scenario; and what has to hold in every call.

    With `moves` the vehicle is driven: about 2 m ahead and back, in arcs. Without, it is never activated, and
    never told another velocity than zero. `told` hears of each finding at once. With `scans_only` it is one
    that brings the scans of a robot that another one drives.

    Raises:
        ScenarioError: the driver refuses the robot's parameters.
    """
    chosen = next(one for one in scenario.robots if one.id == robot)
    factory(scenario, chosen, endpoint)
    suite = _Suite(lambda: factory(scenario, chosen, endpoint), scenario, chosen, rig, patience_s, scans_only)
    findings = []
    for finding in suite.findings(properties or PROPERTIES, moves):
        told(finding)
        findings.append(finding)
    return findings


class Look(NamedTuple):
    """What a driver made of its vehicle, without moving it."""

    state: DriverState
    """How far it came; "configured" where all is well."""
    reason: str
    """Why no further, or why it is not controllable; empty where all is well."""
    after_s: float
    """How long that took."""
    motion_hz: float
    scan_hz: float
    """How often it reported then."""
    motion: Motion | None
    """The last."""
    answers: Mapping[str, str]
    """What the vehicle said of itself."""


def look(
    factory: DriverFactory,
    scenario: Scenario,
    robot: str,
    rig: Rig,
    *,
    endpoint: str = "",
    patience_s: float = PATIENCE_S,
    scans_only: bool = False,
) -> Look:
    """Connect the driver of `robot` (its id) and configure it, listen for three seconds, and close it again.
    It is not activated, and told no velocity. With `scans_only` it is one that brings the scans of a robot
    that another one drives.

    Raises:
        ManipleError: it can't be connected at all.
    """
    chosen = next(one for one in scenario.robots if one.id == robot)
    suite = _Suite(lambda: factory(scenario, chosen, endpoint), scenario, chosen, rig, patience_s, scans_only)
    began, why = rig.now(), ""
    with suite.bench() as bench:
        try:
            bench.ready()
        except CounterexampleError as error:
            why = f"{error}"
        after_s = to_seconds(rig.now() - began)
        bench.forget()
        if not why:
            bench.run(_LISTEN_S)
        motion = bench.motions[-1][1] if bench.motions else None
        if motion is not None and not motion.controllable:
            why = motion.reason
        driver = bench.driver
        return Look(
            driver.state,
            why,
            after_s,
            len(bench.motions) / _LISTEN_S,
            bench.scans / _LISTEN_S,
            motion,
            dict(driver.answers()) if isinstance(driver, Answering) else {},
        )


class _Always:
    """What has to hold in every call, whichever property is being tried."""

    def __init__(self, robot: str, capabilities: Capabilities) -> None:
        self._robot = robot
        self._able = capabilities
        self._names = (
            "every report is sound",
            "its states follow the life cycle",
            "what it applies is within what it can do",
            "no call blocks",
        )
        self._found: dict[str, str] = {}

    def findings(self) -> list[Finding]:
        """The properties, with the first counterexample of each."""
        return [Finding(name, self._found.get(name, "")) for name in self._names]

    def reported(self, report: Motion | Scan, states: Collection[DriverState]) -> None:
        """It said something while it was in one of `states`."""
        if problem := self._unsound(report, states):
            self._note(0, problem)
        if isinstance(report, Motion):
            self.applied(Velocity(*report.applied, report.applied_v_mps), "it reports that it applies")

    def stepped(self, before: DriverState, asked: Step | None, after: DriverState) -> None:
        """Its state has changed, `asked` being what was asked last."""
        ways = {LIFE_CYCLE.get((before, step)) for step in ("fail", asked) if step}
        if after != before and after not in ways:
            told = f"it was told to {asked}" if asked else "nobody told it to"
            self._note(1, f"from {before} it went to {after}; {told}")

    def applied(self, velocity: Velocity, what: str) -> None:
        """It says what it does."""
        able, (u, w, v) = self._able, velocity
        lowest = -able.u_max_mps if able.reverse else 0.0
        most = f"at most u = {able.u_max_mps}, w = {able.w_max_radps}, v = {able.v_max_mps}"
        if not all(map(math.isfinite, velocity)):
            self._note(2, f"{what} {_shown(velocity)}")
        elif (
            not lowest - 1e-6 <= u <= able.u_max_mps + 1e-6
            or abs(w) > able.w_max_radps + 1e-6
            or abs(v) > able.v_max_mps + 1e-6
        ):
            backwards = "" if able.reverse else ", not backwards"
            self._note(2, f"{what} {_shown(velocity)}; it can {most}{backwards}")

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """A call that should not block."""
        began = time.monotonic()
        yield
        if (took := time.monotonic() - began) > BLOCKED_S:
            self._note(3, f"{what} took {took:.2f} s")

    def _note(self, which: int, counterexample: str) -> None:
        self._found.setdefault(self._names[which], counterexample)

    def _unsound(self, report: Motion | Scan, states: Collection[DriverState]) -> str:
        if not isinstance(report, Motion | Scan):
            return f"it reports a {type(report).__name__}; must be a Motion or a Scan"
        name = topics.motion(self._robot) if isinstance(report, Motion) else topics.scan(self._robot)
        try:
            codec.decode(name, codec.encode(report))
        except (MessageError, TypeError, ValueError, OverflowError) as error:
            return f"{error}"
        if isinstance(report, Scan):
            return ""
        if report.pose is not None and not all(map(math.isfinite, (*report.pose, *report.twist))):
            return f"pose {report.pose}, twist {report.twist}"
        if report.state not in states:
            return f"it reports that it is {report.state}, and is {' or '.join(sorted(states))}"
        if report.controllable and report.reason:
            return f"it is controllable, with the reason {report.reason!r}"
        if not report.controllable and not report.reason:
            return "it is not controllable and does not say why"
        if report.controllable and report.state in ("configured", "active") and not _has_values(report):
            return f"it is {report.state} and controllable, and reports neither counts nor a pose"
        return ""


class _Bench:
    """One driver on the rig, called as its process does."""

    def __init__(self, suite: "_Suite") -> None:
        self._rig, self._always, self._patience_s = suite.rig, suite.always, suite.patience_s
        self._wheels, self._able, self._scans_only = suite.wheels, suite.able, suite.scans_only
        self.driver = suite.make()
        self.order: Drive | None = None
        """What is written in every turn, clipped as the process does; None: nothing."""
        self.applied = Velocity()
        """What the last `write` returned."""
        self.motions: deque[tuple[Time, Motion]] = deque(maxlen=10_000)
        """What was reported, with when."""
        self.scans = 0
        self._valued: tuple[Time, Motion] | None = None
        self._scanned: Time | None = None
        self._reckoning = Reckoning()
        self._asked: Step | None = None
        self._asked_at: Time = 0

    def take(self, step: Step) -> None:
        """Ask for a step."""
        now, before = self._rig.now(), self.driver.state
        self._asked, self._asked_at = step, now
        self.driver.take(step, now)
        self._always.stepped(before, step, self.driver.state)

    def turn(self) -> None:
        """One turn of the process."""
        self._rig.wait(PERIOD)
        now, before = self._rig.now(), self.driver.state
        with self._always.timed("read"):
            reports = self.driver.read(now)
        after = self.driver.state
        self._always.stepped(before, self._asked, after)
        for report in reports:
            self._always.reported(report, {before, after})
            if isinstance(report, Motion):
                self._heard(report, now)
            else:
                self.scans, self._scanned = self.scans + 1, now
        if self.order is not None:
            order = clipped(self.order, self._able)
            with self._always.timed("write"):
                self.applied = self.driver.write(order, now)
            self._always.applied(self.applied, f"told {_shown(_told(order))} it applies")
            self._always.stepped(after, self._asked, self.driver.state)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Turn after turn, until something is so; whether it came to be."""
        end = self._rig.now() + from_seconds(seconds)
        while self._rig.now() < end:
            self.turn()
            if until():
                return True
        return False

    def bring(self, target: DriverState) -> None:
        """Take it to a state, step by step, through faults if it has any."""
        since, why = self._rig.now(), self.driver.reason
        while (state := self.driver.state) != target:
            now = self._rig.now()
            if now - since > from_seconds(self._patience_s):
                raise CounterexampleError(
                    f"after {self._patience_s:g} s it is {state}, and should be {target}: "
                    f"{self.driver.reason or why or 'it gives no reason'}"
                )
            step = _towards(state, target)
            if step != self._asked or now - self._asked_at > from_seconds(_AGAIN_S):
                self.take(step)
            why = self.driver.reason or why
            self.turn()
        self._asked = None

    def ready(self, target: DriverState = "configured") -> None:
        """Take it to a state in which it says how its vehicle moves, and, if it is active, lets itself be
        controlled."""
        self.bring(target)
        active = target == "active"
        if active:
            self.tell()
        if not self.run(self._patience_s, self.controllable if active else self.heard):
            silent = f"has not said {'what it sees' if self._scans_only else 'how its vehicle moves'}"
            what = "not controllable" if active else silent
            raise CounterexampleError(
                f"after {self._patience_s:g} s it is {self.driver.state}, but {what}: {self.reason()}"
            )

    def tell(self, u: float = 0.0, w: float = 0.0, v: float = 0.0) -> None:
        """From now on this is ordered."""
        self.order = Drive(u_mps=u, w_radps=w, v_mps=v, active=True, controller_alive=True)

    def forget(self) -> None:
        """What was reported."""
        self.motions.clear()
        self.scans = 0
        self._valued = self._scanned = None

    def heard(self) -> bool:
        """Whether it has said how its vehicle moves, or what it sees if it only does that, and recently."""
        valued = None if self._valued is None else self._valued[0]
        at = self._scanned if self._scans_only else valued
        return at is not None and self._rig.now() - at < from_seconds(FLIGHT_S)

    def controllable(self) -> bool:
        """And that it is controllable."""
        return self.heard() and bool(self.motions) and self.motions[-1][1].controllable

    def lost(self) -> bool:
        """Whether it has told that it can't be controlled."""
        return self.driver.state == "fault" or bool(self.motions and not self.motions[-1][1].controllable)

    def velocity(self) -> Velocity:
        """How the vehicle moves.

        Raises:
            LeftOutError: neither the rig nor a recent report says.
        """
        return self._rig.velocity() or self.reported()

    def reported(self) -> Velocity:
        """How it moves by its own account."""
        if self._valued is None or not self.heard():
            raise LeftOutError("nobody measures how the vehicle moves")
        motion = self._valued[1]
        return Velocity(*motion.twist) if motion.pose is not None else self._reckoning.velocity

    def counts(self) -> bool:
        """Whether it reports counts of its wheels, not poses."""
        return self._valued is not None and self._valued[1].pose is None

    def stands(self) -> bool:
        """Whether the vehicle does."""
        return _stands(self.velocity())

    def must_stand(self, seconds: float, when: str) -> None:
        """See that it stands within a time, and goes on standing.

        Raises:
            CounterexampleError: it does not.
        """
        self.run(seconds, self.stands)
        self.run(0.3)
        if not self.stands():
            raise CounterexampleError(f"{when} it still moves after {seconds:g} s: {_shown(self.velocity())}")

    def end(self) -> None:
        """Leave it closed, as its process does in the end: stop, deactivate, wait until it stands, close."""
        self.order = None
        self.driver.stop(self._rig.now())
        if self.driver.state == "active":
            self.take("deactivate")
            self.run(STAND_S, lambda: self.driver.state != "active")
        self.take("close")
        self.run(1.0, lambda: self.driver.state == "closed")

    def _heard(self, motion: Motion, now: Time) -> None:
        self.motions.append((now, motion))
        if _has_values(motion):
            self._valued = now, motion
        if motion.ticks:
            if self._reckoning.ticks is not None and len(self._reckoning.ticks) != len(motion.ticks):
                self._reckoning = Reckoning()
            self._reckoning, _ = dead_reckoning.step(self._wheels, self._reckoning, motion.ticks, now)

    def reason(self) -> str:
        """Why it is not what it should be, by its own account."""
        if not self.motions:
            return self.driver.reason or "it has reported nothing"
        return self.motions[-1][1].reason or self.driver.reason or "it reports nothing any more"


class _Suite:
    """The properties, each with a driver of its own."""

    def __init__(
        self,
        make: Callable[[], Driver],
        scenario: Scenario,
        robot: Robot,
        rig: Rig,
        patience_s: float,
        scans_only: bool,
    ) -> None:
        self.make, self.rig, self.robot, self.patience_s = make, rig, robot, patience_s
        self.scans_only = scans_only
        model = scenario.model_of(robot)
        self.wheels = dead_reckoning.wheels_of(model)
        self.able = make().capabilities
        self.always = _Always(robot.id, self.able)
        u = min(U_MPS, 0.5 * self.able.u_max_mps, 0.5 * model.u_max_mps)
        w = min(W_RADPS, 0.5 * self.able.w_max_radps, 0.5 * model.w_max_radps)
        self._u = self._next_u = u
        self._w = min(w, 0.8 * curvature_max(model) * u)
        self._v = min(U_MPS, 0.5 * self.able.v_max_mps)
        self._scans = self.able.scan_hz > 0.0 and (scans_only or robot.scans in ("", robot.driver))

    def findings(self, properties: Sequence["Property"], moves: bool) -> Iterator[Finding]:
        """What becomes of them, one after the other; then of what has to hold in every call."""
        for one in properties:
            yield self.tried(one, moves)
        yield from self.always.findings()

    def tried(self, one: "Property", moves: bool) -> Finding:
        """Whether it holds."""
        if one.moves and self.scans_only:
            return Finding(one.name, left_out="it only brings scans")
        if one.moves and not moves:
            return Finding(one.name, left_out="it would move the vehicle")
        if lacking := sorted(set(one.needs) - set(self.rig.acts)):
            return Finding(one.name, left_out=f"nobody is there to {' and '.join(lacking)} it")
        try:
            one.run(self)
        except CounterexampleError as error:
            return Finding(one.name, f"{error}")
        except LeftOutError as error:
            return Finding(one.name, left_out=f"{error}")
        except Exception as error:  # noqa: BLE001 - a driver of somebody's own may raise anything
            return Finding(one.name, f"raised {type(error).__name__}: {error}")
        return Finding(one.name)

    @contextmanager
    def bench(self) -> Iterator[_Bench]:
        """A driver of its own, which is closed in the end whatever happens; so that one that raises leaves no
        vehicle driving."""
        bench = _Bench(self)
        try:
            yield bench
        except BaseException:
            with contextlib.suppress(Exception):
                bench.end()
            raise
        bench.end()

    def capable(self) -> None:
        """The numbers make sense, and are the same once it is connected."""
        able = self.able
        if not all(map(math.isfinite, (able.u_max_mps, able.w_max_radps, able.v_max_mps, able.motion_hz))):
            raise CounterexampleError(f"not all are finite: {able}")
        wrong = [
            text
            for text, good in (
                (f"u_max_mps = {able.u_max_mps}: must be positive", able.u_max_mps > 0.0),
                (f"w_max_radps = {able.w_max_radps}: must not be negative", able.w_max_radps >= 0.0),
                (f"v_max_mps = {able.v_max_mps}: must not be negative", able.v_max_mps >= 0.0),
                (f"motion_hz = {able.motion_hz}: must be positive", able.motion_hz > 0.0),
                (f"scan_hz = {able.scan_hz}: must not be negative", able.scan_hz >= 0.0),
                (
                    f"frame = {able.frame!r}: must be {edges.WORLD!r} or {self.robot.id!r}",
                    able.frame in (edges.WORLD, self.robot.id),
                ),
            )
            if not good
        ]
        if wrong:
            raise CounterexampleError("; ".join(wrong))
        with self.bench() as bench:
            if bench.driver.state != "closed":
                raise CounterexampleError(f"a new one is {bench.driver.state}; must be closed")
            bench.bring("configured")
            if bench.driver.capabilities != able:
                raise CounterexampleError(f"connected it says {bench.driver.capabilities}, before {able}")

    def idle(self) -> None:
        """Making one does nothing outside."""
        with watched(_OUTSIDE) as called:
            self.make()
        if called:
            raise CounterexampleError(f"it calls {', '.join(sorted(called))}")

    def refusals(self) -> None:
        """What `LIFE_CYCLE` does not list is refused, and changes nothing."""
        with self.bench() as bench:
            for state in _UP[:-1]:
                bench.bring(state)
                for step in ("connect", "configure", "activate", "deactivate"):
                    if (state, step) not in LIFE_CYCLE:
                        self._refused(bench, state, step)

    def comes_up(self) -> None:
        """And goes down, and up again."""
        with self.bench() as bench:
            for _ in range(2):
                bench.ready()
                bench.bring("closed")
                bench.forget()
                bench.run(1.0)
                if bench.scans or any(_has_values(motion) for _, motion in bench.motions):
                    raise CounterexampleError("closed it goes on reporting")

    def rates(self) -> None:
        """Over three seconds."""
        with self.bench() as bench:
            bench.ready()
            bench.forget()
            bench.run(_LISTEN_S)
            for what, count, hz in (
                ("motion", len(bench.motions), 0.0 if self.scans_only else self.able.motion_hz),
                ("scan", bench.scans, self.able.scan_hz if self._scans else 0.0),
            ):
                if hz and not 0.5 * hz <= count / _LISTEN_S <= 1.5 * hz:
                    raise CounterexampleError(f"{what}: {count / _LISTEN_S:.1f} /s; it promises {hz:g}")

    def any_state(self) -> None:
        """`stop` and `see`, wherever it is in its life."""
        pose = ExternalPose(pose=(0.0, 0.0, 0.0))
        with self.bench() as bench:
            driver = bench.driver
            for state in _UP[:-1]:
                bench.bring(state)
                for what, call in (("stop", driver.stop), ("see", partial(driver.see, pose))):
                    try:
                        call(self.rig.now())
                    except Exception as error:
                        raise CounterexampleError(
                            f"{what} while {state} raised {type(error).__name__}: {error}"
                        ) from error
                    if driver.state != state:
                        raise CounterexampleError(f"{what} while {state} left it {driver.state}")

    def silent(self) -> None:
        """The vehicle is not heard any more. That nothing is reported is told by the driver's process."""
        with self.bench() as bench, self._cut(bench):
            bench.run(FLIGHT_S)
            bench.forget()
            bench.run(3.0)
            if bench.scans:
                raise CounterexampleError(f"more than {FLIGHT_S:g} s after the cut it reports scans")
            for _, motion in bench.motions:
                if _has_values(motion):
                    where = motion.ticks if motion.pose is None else motion.pose
                    raise CounterexampleError(f"more than {FLIGHT_S:g} s after the cut it reports {where}")
                if motion.controllable:
                    raise CounterexampleError("after the cut it reports that it is controllable")

    def back(self) -> None:
        """Once the link is restored, without being made anew."""
        with self.bench() as bench:
            with self._cut(bench):
                bench.run(4.0)
            bench.forget()
            bench.ready()

    def inactive(self) -> None:
        """An order to move, while it is still being brought up."""
        with self.bench() as bench:
            for state in _UP[:-1]:
                bench.bring(state)
                for active in (False, True):
                    bench.order = Drive(u_mps=self._u, w_radps=self._w, active=active, controller_alive=True)
                    bench.run(1.0 if state == "configured" else 0.2)
                    if bench.driver.state == state and not _stands(bench.applied):
                        raise CounterexampleError(
                            f"while {state} it was told {_shown(_told(bench.order))}, and applies "
                            f"{_shown(bench.applied)}"
                        )
                    if state == "configured" and not bench.stands():
                        raise CounterexampleError(f"while {state} it moves: {_shown(bench.velocity())}")
                bench.order = None

    def drives(self) -> None:
        """Ahead, in an arc to the left, and where it can backwards and sideways."""
        with self.bench() as bench:
            bench.ready("active")
            u = self._u
            trials = [(Velocity(u, 0.0), 0), (Velocity(u, self._w), 1)]
            if self.able.reverse:
                trials.append((Velocity(-u, 0.0), 0))
            if self._v:
                trials.append((Velocity(0.0, 0.0, self._v), 2))
            for told, axis in trials:
                bench.tell(*told)
                bench.run(3.0)
                for who, found in (("the vehicle moves", bench.velocity()), ("it reports", bench.reported())):
                    if not 0.5 < found[axis] / told[axis] < 1.5:
                        raise CounterexampleError(f"told {_shown(told)}, {who} {_shown(found)}")

    def agrees(self) -> None:
        """Where it says that it is goes where it says that it drives."""
        with self.bench() as bench:
            bench.ready("active")
            u = self._there_or_back()
            bench.tell(u, self._w)
            bench.run(1.0)
            if bench.counts():
                raise LeftOutError("it reports counts, of which the agent makes both")
            bench.forget()
            bench.run(6.0)
            way = 0.0
            for moved, reckoned, way in _ways(bench.motions):
                off = math.hypot(moved.x - reckoned.x, moved.y - reckoned.y)
                turned = abs(wrap(moved.psi - reckoned.psi))
                if off > 0.05 + 0.1 * way or turned > 0.1 + 0.1 * abs(reckoned.psi):
                    raise CounterexampleError(
                        f"by its poses it went {_where(moved)}, by its twists {_where(reckoned)}"
                    )
            if way < 3.0 * abs(u):
                raise CounterexampleError(
                    f"told {_shown(Velocity(u, self._w))} for 6 s, it went {way:.2f} m by its twists"
                )

    def full_speed(self) -> None:
        """For a second, and too much is asked for: what it applies is watched in every call."""
        able = self.able
        with self.bench() as bench:
            bench.ready("active")
            for sign in (1.0, -1.0):
                told = Velocity(sign * able.u_max_mps, sign * able.w_max_radps)
                bench.tell(2.0 * told.u, 2.0 * told.w)
                bench.run(1.0)
                found = bench.velocity()
                if abs(found.u) > 1.1 * abs(told.u) + 0.05 or abs(found.w) > 1.1 * abs(told.w) + 0.05:
                    raise CounterexampleError(f"told {_shown(told)} it moves {_shown(found)}")
                if not able.reverse and found.u < -STILL_MPS:
                    raise CounterexampleError(f"it drives backwards, and says that it can't: {_shown(found)}")
                bench.tell()
                bench.run(2.0)

    def stops(self) -> None:
        """`stop` while it drives, and nothing is told any more."""
        with self.bench() as bench:
            self._driving(bench)
            bench.order = None
            bench.driver.stop(self.rig.now())
            bench.must_stand(2.0, "stopped")

    def deactivates(self) -> None:
        """As the process does when its agent ends: stopped, told to stand for a while, deactivated."""
        with self.bench() as bench:
            self._driving(bench)
            bench.driver.stop(self.rig.now())
            bench.order = STAND
            bench.run(to_seconds(ZEROS))
            bench.order = None
            bench.take("deactivate")
            if not bench.run(STAND_S, lambda: bench.driver.state == "configured"):
                raise CounterexampleError(f"{STAND_S:g} s after deactivate it is {bench.driver.state}")
            bench.must_stand(1.0, "deactivated")
            bench.take("close")
            bench.run(1.0)
            if bench.driver.state != "closed":
                raise CounterexampleError(f"1 s after close it is {bench.driver.state}")

    def closes(self) -> None:
        """In the middle of the way: a process that has no time left."""
        with self.bench() as bench:
            self._driving(bench)
            bench.order = None
            bench.driver.stop(self.rig.now())
            bench.take("close")
            if self.rig.velocity() is None:  # then it is looked at again
                bench.run(STAND_S)
                bench.forget()
                bench.ready()
            bench.must_stand(STAND_S, "closed while it drove")

    def unattended(self) -> None:
        """The agent falls silent while it drives: the watchdog of the driver's process does its work."""
        keeper = Keeper(self.able)
        with self.bench() as bench:
            u = self._driving(bench)
            bench.order = None
            keeper.heard(Drive(u_mps=u, w_radps=0.0, active=True), self.rig.now())

            def kept() -> bool:
                now = self.rig.now()
                for action in keeper.due(bench.driver.state, False, now):
                    if isinstance(action, Take):
                        bench.take(action.step)
                    elif isinstance(action, Halt):
                        bench.driver.stop(now)
                    else:
                        bench.driver.write(action.drive, now)
                return False

            bench.run(to_seconds(WATCHDOG) + 2.0, kept)
            bench.must_stand(0.0, "without a word of its agent")

    def deserted(self) -> None:
        """The link is cut while it drives: the vehicle stands by itself, and after it as well."""
        with self.bench() as bench:
            if self.rig.velocity() is None:
                raise LeftOutError("nobody measures how the vehicle moves")
            with self._cut(bench, "active"):
                bench.must_stand(STAND_S, "with its link cut")
            bench.order = None
            bench.forget()
            bench.bring("configured")
            bench.must_stand(1.0, "with its link restored")

    def taken(self) -> None:
        """Somebody takes it while it drives: said soon and with a reason, not fought, and over in the end."""
        with self.bench() as bench:
            self._driving(bench)
            self.rig.act("take")
            try:
                bench.run(NOTICE_S, bench.lost)
                bench.run(1.0)
                self._still_taken(bench)
                bench.order = None
                if bench.driver.state == "active":  # as its agent does: it waits
                    bench.take("deactivate")
                bench.run(2.0)
                self._still_taken(bench)
            finally:
                self.rig.act("give")
            bench.forget()
            self._driving(bench)

    def _still_taken(self, bench: _Bench) -> None:
        if not self.rig.taken():
            raise CounterexampleError("it took it back from whoever had it")
        if not bench.lost():
            raise CounterexampleError("it says that it is controllable while somebody else has it")

    def _refused(self, bench: _Bench, state: DriverState, step: Step) -> None:
        try:
            bench.driver.take(step, self.rig.now())
        except ManipleError:
            pass
        else:
            raise CounterexampleError(f"while {state} it takes the step {step}")
        if bench.driver.state != state:
            raise CounterexampleError(f"while {state} it refuses {step}, and is {bench.driver.state}")

    def _there_or_back(self) -> float:
        """The speed (m/s) to drive with: ahead, and back the next time, where it can."""
        u = self._next_u
        self._next_u = -u if self.able.reverse else u
        return u

    def _driving(self, bench: _Bench) -> float:
        """Ready, and on its way; how fast (m/s) it was told."""
        bench.ready("active")
        u = self._there_or_back()
        bench.tell(u)
        bench.run(2.0)
        if bench.stands():
            why = bench.motions[-1][1].reason
            raise CounterexampleError(f"told {_shown(Velocity(u))} it stands" + (f": {why}" if why else ""))
        return u

    @contextmanager
    def _cut(self, bench: _Bench, state: DriverState = "configured") -> Iterator[None]:
        """Its link is cut in the block, which begins in a state; if that is active, while it drives."""
        if state == "active":
            self._driving(bench)
        else:
            bench.ready(state)
        self.rig.act("cut")
        try:
            yield
        finally:
            self.rig.act("restore")


class Property(NamedTuple):
    """What is tried."""

    name: str
    run: Callable[[_Suite], None]
    needs: Sequence[Act] = ()
    moves: bool = False


PROPERTIES = (
    Property("says what it can do before it is connected", _Suite.capable),
    Property("is made without any input or output", _Suite.idle),
    Property("comes up and down step by step", _Suite.comes_up),
    Property("refuses steps that are not open", _Suite.refusals),
    Property("takes stop and poses from outside in any state", _Suite.any_state),
    Property("reports as often as it promises", _Suite.rates),
    Property("says nothing while its vehicle does", _Suite.silent, ("cut", "restore")),
    Property("comes back when its vehicle does", _Suite.back, ("cut", "restore")),
    Property("moves nothing before it is active", _Suite.inactive, moves=True),
    Property("drives where it is told, and reports that", _Suite.drives, moves=True),
    Property("its poses go where its twists say", _Suite.agrees, moves=True),
    Property("never drives faster than it can", _Suite.full_speed, moves=True),
    Property("stands when it is stopped", _Suite.stops, moves=True),
    Property("stands when it is deactivated and closed", _Suite.deactivates, moves=True),
    Property("stands when it is closed on its way", _Suite.closes, moves=True),
    Property("stands when its agent falls silent", _Suite.unattended, moves=True),
    Property("stands when its link is cut on its way", _Suite.deserted, ("cut", "restore"), moves=True),
    Property("tells who has it, does not fight, comes back", _Suite.taken, ("take", "give"), moves=True),
)
"""Of one driver, in the order in which they are tried."""

_UP: Sequence[DriverState] = ("closed", "connected", "configured", "active")

_STEPS: Mapping[DriverState, Step] = {
    "connected": "connect",
    "configured": "configure",
    "active": "activate",
}
"""That lead up to a state."""

_OUTSIDE = frozenset(
    {"open", "connect", "connect_ex", "bind", "listen", "accept", "select", "poll", "sleep", "fork_exec"}
    | {"getaddrinfo", "start_new_thread", "start_joinable_thread"}
)
"""Functions written in C that do what a constructor must not."""


def _towards(state: DriverState, target: DriverState) -> Step:
    """The next step from one state to another."""
    if state == "fault" or target == "closed":
        return "close"
    if state == "active":
        return "deactivate"
    if _UP.index(state) > _UP.index(target):
        return "close"
    return _STEPS[_UP[_UP.index(state) + 1]]


def _has_values(motion: Motion) -> bool:
    return bool(motion.ticks) or motion.pose is not None


def _stands(velocity: Velocity) -> bool:
    return math.hypot(velocity.u, velocity.v) < STILL_MPS and abs(velocity.w) < STILL_RADPS


def _told(drive: Drive) -> Velocity:
    return Velocity(drive.u_mps, drive.w_radps, drive.v_mps)


def _shown(velocity: Velocity) -> str:
    u, w, v = velocity
    return f"u = {u:.3f} m/s, w = {w:.3f} rad/s" + (f", v = {v:.3f} m/s" if v else "")


def _where(pose: Pose) -> str:
    return f"({pose.x:.2f} m, {pose.y:.2f} m, {pose.psi:.2f} rad)"


def _ways(motions: Sequence[tuple[Time, Motion]]) -> Iterator[tuple[Pose, Pose, float]]:
    """Where a robot was at each report, in the frame in which it began: by its poses, and by its twists, each
    of which holds, in the mean with the one before, since that; and how long its way was (m)."""
    reckoned, way = Pose(0.0, 0.0, 0.0), 0.0
    told = [(now, Pose(*motion.pose), motion.twist) for now, motion in motions if motion.pose is not None]
    for (before, _, twist), (now, pose, new) in pairwise(told):
        dt = to_seconds(now - before)
        u, w, v = (0.5 * dt * (a + b) for a, b in zip(twist, new, strict=True))
        reckoned, way = reckoned.advance(u, w, v), way + math.hypot(u, v)
        yield told[0][1].inverse().compose(pose), reckoned, way
