"""The process of a presented robot: between the simulated body and the vehicle it shows itself as.

It is no node: it keeps no journal, and what it does is not run again. What it says to the body is numbered,
stamped and sealed all the same, and recorded.
"""

import traceback
from collections import Counter

from maniple.core import topics
from maniple.core.edges import vehicle_of
from maniple.core.envelope import envelope_of
from maniple.core.errors import ManipleError, MessageError, RunError
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, period
from maniple.host.clock import Anchor
from maniple.host.edge import Membership
from maniple.host.fate import Meet, meet
from maniple.host.inbox import Arrived, Inbox, Item, Stop
from maniple.host.inlets import Inlets
from maniple.host.stamper import Stamper
from maniple.transport.zenoh import ZenohSession
from simulator.vehicles.interface import STEP, Vehicle

_STAND = Drive(u_mps=0.0, w_radps=0.0, active=False)


class VehicleHost:
    """Runs one life of the vehicle of `robot` until `stop` is called, or a newer life of it takes over."""

    def __init__(
        self,
        vehicle: Vehicle,
        robot: str,
        incarnation: int,
        scenario: Scenario,
        clock: Anchor,
        fleet: ZenohSession,
        hardware: ZenohSession,
        meet: Meet = meet,
    ) -> None:
        self._vehicle = vehicle
        self._name = vehicle_of(robot)
        self._clock = clock
        self._hardware = hardware
        self._topic = topics.simulated_drive(robot)
        self._sources = (topics.simulated_motion(robot), topics.simulated_scan(robot))
        self._again = period(scenario.rates.drive_hz)
        self._stamper = Stamper(self._name, incarnation)
        self._inlets = Inlets(scenario.rates)
        self._inbox = Inbox()
        self._member = Membership(self._name, incarnation, scenario, clock, fleet, self._inbox, meet)
        self._order, self._sent = _STAND, -(2**62)

    @property
    def refused(self) -> Counter[str]:
        """What arrived and was not taken in, by reason; "over its protocol" is the vehicle's own count."""
        return self._member.refused

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self) -> None:
        """Switch the vehicle on, run it, and leave the body standing.

        Raises:
            ManipleError: the vehicle can't be switched on.
            RunError: it failed, or a newer life of it has taken over.
        """
        self._member.listen()
        for source in self._sources:
            self._hardware.subscribe(source, self._inbox.arrived, self._inbox.unfit, topics.has_known_senders)
        self._hardware.settle()
        try:
            self._vehicle.open(self._clock.now())
            self._member.announce()
            self._go()
        except ManipleError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever fails, the body must not drive on
            traceback.print_exc()
            raise RunError(f"{self._name} failed: {type(error).__name__}: {error}") from None
        finally:
            now = self._clock.now()
            self._send(_STAND, now)
            if refused := self._vehicle.refused:
                self.refused["over its protocol"] = refused
            self._member.tell()
            self._vehicle.close(now)
        self._member.require_newest()

    def _go(self) -> None:
        due = self._clock.now()
        while True:
            for item in self._inbox.take(self._clock.wall_seconds(due - self._clock.now())):
                if not self._take(item):
                    return
            self._member.act()
            now = self._clock.now()
            if now >= due:
                order = self._vehicle.step(now)
                if order != self._order or now - self._sent >= self._again:
                    self._send(order, now)
                due += ((now - due) // STEP + 1) * STEP

    def _take(self, item: Item) -> bool:
        """Deal with what arrived; whether to go on."""
        if isinstance(item, Stop):
            return False
        if not self._member.take(item) and isinstance(item, Arrived):
            self._arrived(item)
        return not self._member.is_over

    def _arrived(self, item: Arrived) -> None:
        now = self._clock.now()
        try:
            envelope = envelope_of(item.topic, item.data)
        except MessageError:
            self.refused["malformed"] += 1
            return
        judged = self._inlets.judge(envelope, now)
        if isinstance(judged, str):
            self.refused[judged] += 1
        elif isinstance(judged, Motion | Scan):
            self._vehicle.see(judged, now)

    def _send(self, order: Drive, now: Time) -> None:
        self._order, self._sent = order, now
        self._hardware.put(self._topic, self._stamper.stamp(self._topic, order, now).data)
