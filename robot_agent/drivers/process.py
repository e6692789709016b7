"""The process of a robot's driver: between `hw/ID/drive|motion|scan` and a `Driver`.

It is no node: it keeps no journal, and what it does is not run again. What it says is numbered, stamped and
sealed all the same, and recorded.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable

from msgspec.structs import replace

from maniple.core import topics
from maniple.core.envelope import envelope_of
from maniple.core.errors import ManipleError, MessageError, ScenarioError
from maniple.core.messages import Drive, ExternalPose, Motion, Scan
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import MILLISECOND, Duration, Time, period
from maniple.host.clock import Anchor
from maniple.host.edge import Membership
from maniple.host.fate import Meet, meet, say
from maniple.host.inbox import Arrived, Inbox, Item, Stop
from maniple.host.inlets import Inlets
from maniple.host.stamper import Stamper
from maniple.transport.zenoh import ZenohSession
from robot_agent.drivers.interface import Driver, Successor
from robot_agent.drivers.keeper import LATE, Halt, Keeper, Lateness, Standing, Take

STEP_S = 0.01
"""How often the driver is read where nothing arrives."""
HANGS_S = 5.0
"""A driver that does not return for so long takes its process with it: others can do without it then."""
_LOOK_S = 0.25
_LATE_PERIODS = 2.5
_LATE: Duration = 400 * MILLISECOND
"""A driver that has not said how its robot moves for so many periods, and so long, has its process say so. A
radio that loses a report or two is no reason for a robot to stop."""


class DriverHost:
    """Runs one life of the process `name` of a robot's driver until `stop` is called, or a newer life of it
    takes over. `make` makes the driver, and another one where it fails."""

    def __init__(
        self,
        make: Callable[[], Driver],
        robot: Robot,
        name: str,
        incarnation: int,
        scenario: Scenario,
        clock: Anchor,
        fleet: ZenohSession,
        hardware: ZenohSession,
        meet: Meet = meet,
    ) -> None:
        self._make = make
        self._driver = make() if incarnation == 1 else self._make_next()
        self._name = name
        self._clock = clock
        self._hardware = hardware
        self._drive, self._pose = topics.drive(robot.id), topics.external_pose(robot.id)
        self._motion, self._scan = topics.motion(robot.id), topics.scan(robot.id)
        moves = topics.may_send(self._motion, name)
        self._says = {
            Motion: self._motion if moves else "",
            Scan: self._scan if not moves or robot.scans in ("", robot.driver) else "",
        }
        self._heeds = (self._drive, self._pose) if moves else ()
        self._inbox = Inbox()
        self._member = Membership(name, incarnation, scenario, clock, fleet, self._inbox, meet)
        self._inlets = Inlets(scenario.rates)
        self._stamper = Stamper(name, incarnation)
        self._digest = short_digest(scenario)
        self._keeper = Keeper(self._driver.capabilities)
        self._lateness = Lateness()
        self._standing = Standing()
        self._period: Duration = period(self._driver.capabilities.motion_hz)
        self._overdue: Time = 0
        self._trouble = ""
        self._steps = 0

    def stop(self) -> None:
        """Make `run` bring the robot to a stand and end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self) -> None:
        """Keep the driver going.

        Raises:
            ScenarioError: the driver can't work with its parameters, or something is not installed.
            RunError: a newer life has taken over.
        """
        self._member.listen()
        for topic in self._heeds:
            self._hardware.subscribe(topic, self._inbox.arrived, self._inbox.unfit, topics.has_known_senders)
        self._hardware.settle()
        self._member.announce()
        ended = threading.Event()
        threading.Thread(target=self._mind, args=(ended,), daemon=True).start()
        try:
            self._go()
        finally:
            ended.set()
            if not self._keeper.done:
                self._give_up()
            self._member.tell()
        self._member.require_newest()

    def _go(self) -> None:
        while not (self._keeper.done or self._member.is_over):
            for item in self._inbox.take(STEP_S):
                if not self._member.take(item):
                    self._take(item)
            self._member.act()
            self._step()

    def _take(self, item: Item) -> None:
        """Deal with what arrived from the agent, or from who ends this."""
        if isinstance(item, Stop):
            self._keeper.end(time.monotonic_ns())
        elif isinstance(item, Arrived) and (refusal := self._arrived(item)):
            self._member.refused[refusal] += 1

    def _arrived(self, item: Arrived) -> str:
        """Take a message in. Returns why it is not, or nothing."""
        try:
            envelope = envelope_of(item.topic, item.data)
        except MessageError:
            return "malformed"
        message = self._inlets.judge(envelope, item.monotonic_ns)
        if isinstance(message, Drive):
            took = self._lateness.of(message.incarnation, message.stamp_ns, item.monotonic_ns)
            if took > LATE:
                return "late"
            self._keeper.heard(message, item.monotonic_ns)
        elif isinstance(message, ExternalPose):
            self._attempt(lambda now: self._driver.see(message, now))
        else:
            return str(message)
        return ""

    def _step(self) -> None:
        """Hear the driver and tell it what is due."""
        self._steps += 1
        self._attempt(self._read)
        self._attempt(self._fill_in)
        self._attempt(self._act)

    def _read(self, now: Time) -> None:
        for report in self._driver.read(now):
            if isinstance(report, Motion):
                self._standing.take(report, now)
                self._overdue = now + max(round(_LATE_PERIODS * self._period), _LATE)
            self._say(report)

    def _act(self, now: Time) -> None:
        driver = self._driver
        if driver.state not in ("closed", "fault"):
            self._trouble = ""
        for action in self._keeper.due(driver.state, self._standing.holds(now), now):
            if isinstance(action, Take):
                driver.take(action.step, now)
            elif isinstance(action, Halt):
                driver.stop(now)
            else:
                driver.write(action.drive, now)

    def _fill_in(self, now: Time) -> None:
        """Where the driver does not say how its robot moves, say why not."""
        if now < self._overdue:
            return
        self._overdue = now + self._period
        state = "fault" if self._trouble else self._driver.state
        silent = "not connected yet" if state == "closed" else "no word from the vehicle"
        reason = self._trouble or self._driver.reason or silent
        self._say(Motion(ticks=(), applied=(0.0, 0.0), state=state, controllable=False, reason=reason))

    def _attempt(self, work: Callable[[Time], None]) -> None:
        """Do something with the driver; where it fails, there is another one from now on.

        Raises:
            ScenarioError: that would not help.
        """
        try:
            work(time.monotonic_ns())
        except ScenarioError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever a driver does, its robot must not drive on
            text = str(error) if isinstance(error, ManipleError) else f"{type(error).__name__}: {error}"
            if text != self._trouble:
                say(f"{self._name}: the driver failed: {text}")
            self._give_up()
            self._trouble = text
            self._keeper.failed(time.monotonic_ns())
            self._driver = self._make_next()

    def _make_next(self) -> Driver:
        """A driver after another one."""
        driver = self._make()
        if isinstance(driver, Successor):
            driver.succeed()
        return driver

    def _give_up(self) -> None:
        """Stop the robot and let go of it, as far as the driver can."""
        now = time.monotonic_ns()
        with contextlib.suppress(Exception):
            self._driver.stop(now)
        with contextlib.suppress(Exception):
            self._driver.take("close", now)

    def _say(self, report: Motion | Scan) -> None:
        if isinstance(report, Motion):
            report = replace(report, scenario=self._digest)
        if topic := self._says[type(report)]:
            self._hardware.put(topic, self._stamper.stamp(topic, report, self._clock.now()).data)

    def _mind(self, ended: threading.Event) -> None:
        """End this process where its driver does not return. A process that is frozen does not count."""
        seen, looks = -1, 0
        while not ended.wait(_LOOK_S):
            looks = looks + 1 if self._steps == seen else 0
            seen = self._steps
            if looks * _LOOK_S >= HANGS_S:
                say(f"{self._name}: the driver has not returned for {HANGS_S:g} s")
                os._exit(1)
