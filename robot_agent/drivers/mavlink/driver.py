"""An ArduPilot Rover as a driver: the connection around `Session`."""

from collections.abc import Mapping, Sequence
from typing import Any

from maniple.control.limits import Velocity
from maniple.core.connections import parse_connection
from maniple.core.edges import WORLD
from maniple.core.errors import ArgumentError, MissingExtraError, ScenarioError, TransportError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Time
from maniple.transport.mavlink import MavlinkLink, load_dialect
from robot_agent.drivers.interface import Capabilities, Step
from robot_agent.drivers.mavlink.frames import Origin
from robot_agent.drivers.mavlink.session import MOST_HZ, Session, Setup

NAME = "mavlink"

COMPONENT_ID = 190
"""MAV_COMP_ID_MISSIONPLANNER: what a ground station goes by."""


class MavlinkDriver:
    """See `robot_agent.drivers.interface.Driver`, and docs/mavlink.md."""

    def __init__(self, scenario: Scenario, robot: Robot, endpoint: str = "") -> None:  # noqa: ARG002
        """The driver of a robot of a resolved scenario. Nothing is opened.

        Raises:
            ScenarioError: its `mavlink` parameters are not valid.
        """
        link, model = robot.mavlink, scenario.model_of(robot)
        where = f"robots: {robot.id}: mavlink"
        try:
            parse_connection(link.connection)
        except ArgumentError as error:
            raise ScenarioError(f"{where}.connection: {error}") from None
        if link.external_pose and link.origin is None:
            raise ScenarioError(
                f"{where}.external_pose needs mavlink.origin: a vehicle without GNSS has to be told where on "
                "Earth the world's (0, 0) is; any place near by will do"
            )
        if model.v_max_mps:
            raise ScenarioError(
                f"robots: {robot.id}: driver = 'mavlink': an ArduPilot Rover does not drive sideways; choose "
                "a model without v_max_mps"
            )
        self.capabilities = Capabilities(
            u_max_mps=model.u_max_mps,
            w_max_radps=model.w_max_radps,
            reverse=True,
            accepts_yaw_rate=True,
            motion_hz=min(scenario.rates.motion_hz, MOST_HZ),
            scan_hz=min(scenario.rates.scan_hz, MOST_HZ),
            frame=robot.id if link.origin is None else WORLD,
        )
        self._connection = link.connection
        self._setup = Setup(
            system_id=link.system_id,
            component_id=link.component_id,
            gcs_system_id=link.gcs_system_id,
            u_max_mps=model.u_max_mps,
            w_max_radps=model.w_max_radps,
            brake_mps2=model.brake_mps2,
            arm=link.arm,
            disarm=link.disarm,
            origin=None if link.origin is None else Origin.of(*link.origin),
            external_pose=link.external_pose,
            motion_hz=scenario.rates.motion_hz,
            scan_hz=scenario.rates.scan_hz,
            ranges=NAME in (robot.scans, robot.driver if not robot.scans else ""),
        )
        self._succeeds = False
        self._session: Session | None = None
        self._link: MavlinkLink | None = None
        self._refused = ""
        self._now: Time = 0

    @property
    def state(self) -> DriverState:
        """Where it is in its life."""
        return self._session.state if self._session is not None else "closed"

    @property
    def reason(self) -> str:
        """Why it is not where it was asked to be."""
        said = self._session.reason if self._session is not None else ""
        if self.state == "closed":
            link = self._link.reason if self._link is not None else self._refused
            return "; ".join(text for text in (link, said) if text)
        return said

    def succeed(self) -> None:
        """Who has the vehicle is not known: see `Session`."""
        self._succeeds = True

    def take(self, step: Step, now: Time) -> None:
        """Begin a step.

        Raises:
            ManipleError: the step is not open in this state.
            ScenarioError: pymavlink or pyserial is not installed.
        """
        if self._session is None:
            self._session = Session(_dialect(self._connection), self._setup, self._succeeds)
        failed = self.state == "fault"
        self._session.take(step, now)
        if step == "connect" and self._link is None:
            try:
                self._link = MavlinkLink.open(self._connection, self._setup.gcs_system_id, COMPONENT_ID)
                self._refused = ""
            except TransportError as error:
                self._refused = str(error)
        self._send()
        self._let_go(step, abandon=failed)

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        """What is new."""
        self._now = now
        session, link = self._session, self._link
        if session is None:
            return ()
        if link is not None:
            session.receive(link.receive(), now)
            if not link.connected:
                session.lost(link.reason, now)
        closing = session.state != "closed"
        session.advance(now)
        self._send()
        if closing:
            self._let_go("close", abandon=False)
        return [said for said in (session.motion(now), session.scan(now)) if said is not None]

    def write(self, drive: Drive, now: Time) -> Velocity:
        """Pass an order on."""
        if self._session is None:
            return Velocity()
        applied = self._session.write(drive, now)
        self._send()
        return applied

    def see(self, pose: ExternalPose, now: Time) -> None:
        """Pass on where others see the vehicle, if it needs that."""
        if self._session is not None:
            self._session.see(pose, now)
            self._send()

    def stop(self, now: Time) -> None:
        """Bring it to a stand."""
        if self._session is not None:
            self._session.stop(now)
            self._send()

    def answers(self) -> Mapping[str, str]:
        """What the vehicle says of itself, for people."""
        if self._session is None:
            return {}
        found = self._session.answers(self._now)
        if found and self._link is not None:
            link = self._link
            found["link"] = f"{link.bad} bad, {link.lost} lost, {link.dropped} not sent"
        return found

    def _send(self) -> None:
        assert self._session is not None
        if self._link is not None:
            for message in self._session.outbox:
                self._link.send(message, to=self._setup.system_id)
        self._session.outbox.clear()

    def _let_go(self, step: Step, abandon: bool) -> None:
        """Close the connection once the session is; what could not be sent to a lost vehicle is thrown away,
        so that it does not arrive late."""
        if step == "close" and self.state == "closed" and self._link is not None:
            self._link.close(abandon=abandon)
            self._link = None


def _dialect(connection: str) -> Any:
    """What has to be installed, at its first use.

    Raises:
        ScenarioError: it is not.
    """
    try:
        return load_dialect(serial=connection.startswith("serial:"))
    except MissingExtraError as error:
        raise ScenarioError(f"driver = 'mavlink': {error}") from None
