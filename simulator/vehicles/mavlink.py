"""A simulated body behind a MAVLink connection: the rover of `simulator.vehicles.rover` and its sockets.

It opens the other end of the connection that the robot's driver looks for it at; others (a pilot's ground
station) may connect there too.
"""

from maniple.core.connections import other_end
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Time
from maniple.transport.mavlink import MavlinkLink
from simulator.vehicles.rover import Rover, Spec, spec_of

_OFF = Drive(u_mps=0.0, w_radps=0.0, active=False)


class MavlinkVehicle:
    """A rover at one end of a connection (as `MavlinkLink` takes it)."""

    def __init__(self, spec: Spec, connection: str) -> None:
        self._spec = spec
        self._connection = connection
        self._link: MavlinkLink | None = None
        self._rover: Rover | None = None

    @property
    def refused(self) -> int:
        """Runs of bytes that arrived and were no frame."""
        return self._link.bad if self._link is not None else 0

    def open(self, now: Time) -> None:
        """Switch the rover on.

        Raises:
            TransportError: it can't listen there.
            MissingExtraError: pymavlink is not installed.
        """
        self._link = MavlinkLink.open(self._connection, self._spec.system_id, self._spec.component_id)
        self._rover = Rover(self._spec, self._link.dialect, now)

    def see(self, report: Motion | Scan, now: Time) -> None:
        """Pass on what the body's sensors say."""
        if self._rover is not None:
            self._rover.see(report, now)

    def step(self, now: Time) -> Drive:
        """Answer, and say what is due."""
        if self._link is None or self._rover is None:
            return _OFF
        said, order = self._rover.step(now, self._link.receive())
        for message, to in said:
            self._link.send(message, to)
        return order

    def close(self, _: Time) -> None:
        """Let go of the connection."""
        if self._link is not None:
            self._link.close()
            self._link = None


def vehicle(scenario: Scenario, robot: Robot, _: str = "") -> MavlinkVehicle:
    """The rover that a robot of a resolved scenario is presented as.

    Raises:
        ScenarioError: nothing of this machine can be at the other end of its connection.
    """
    try:
        return MavlinkVehicle(spec_of(scenario, robot), other_end(robot.mavlink.connection))
    except ArgumentError as error:
        raise ScenarioError(f"robots: {robot.id}: presents = 'mavlink': {error}") from None
