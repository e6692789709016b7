"""A driver to be wrapped: it keeps book of what it is told, moves like a robot without friction, and fails as
it is asked to."""

from collections.abc import Sequence
from math import cos, sin

from maniple.control.limits import Velocity
from maniple.core.errors import RunError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan, pack_floats
from maniple.core.time import MILLISECOND, Time, to_seconds
from robot_agent.drivers.interface import LIFE_CYCLE, Capabilities, Step

CAN = Capabilities(
    u_max_mps=0.5,
    w_max_radps=1.0,
    reverse=True,
    accepts_yaw_rate=True,
    motion_hz=50.0,
    scan_hz=10.0,
    frame="r1",
)


class Bench:
    """`told` are the calls that can move or stop it: ("write", drive), ("stop", None), (step, None)."""

    capabilities = CAN

    def __init__(self) -> None:
        self.state: DriverState = "closed"
        self.reason = ""
        self.told: list[tuple[str, Drive | None]] = []
        self.seen: list[ExternalPose] = []
        self.velocity = Velocity()
        self.succeeds = False
        """Whether it was told that there was another one before it."""
        self.silent = False
        self.scans = False
        self.raises: dict[str, Exception] = {}
        """By the name of the call that is to raise it."""
        self._pose = (0.0, 0.0, 0.0)
        self._at: Time = 0

    def succeed(self) -> None:
        assert not self.told
        self.succeeds = True

    def take(self, step: Step, now: Time) -> None:
        self._fail("take")
        self.told.append((step, None))
        if (self.state, step) not in LIFE_CYCLE:
            raise RunError(f"{step} is not open in the state {self.state}")
        self.state = LIFE_CYCLE[self.state, step]

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        self._fail("read")
        if self.state == "closed" or self.silent or now - self._at < 20 * MILLISECOND:
            return ()
        dt_s, self._at = min(to_seconds(now - self._at), 0.1), now
        (x, y, psi), (u, w, _) = self._pose, self.velocity
        self._pose = x + u * cos(psi) * dt_s, y + u * sin(psi) * dt_s, psi + w * dt_s
        motion = Motion(
            ticks=(), applied=(u, w), state=self.state, controllable=True, pose=self._pose, twist=(u, w, 0.0)
        )
        if not self.scans:
            return (motion,)
        scan = Scan(
            first_angle_rad=0.0,
            increment_rad=0.1,
            range_min_m=0.0,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=pack_floats([1.0, 2.0]),
        )
        return motion, scan

    def write(self, drive: Drive, now: Time) -> Velocity:
        self._fail("write")
        self.told.append(("write", drive))
        self.velocity = Velocity(drive.u_mps, drive.w_radps)
        return self.velocity

    def see(self, pose: ExternalPose, now: Time) -> None:
        self._fail("see")
        self.seen.append(pose)

    def stop(self, now: Time) -> None:
        self._fail("stop")
        self.told.append(("stop", None))
        self.velocity = Velocity()

    def _fail(self, call: str) -> None:
        if error := self.raises.get(call):
            raise error
