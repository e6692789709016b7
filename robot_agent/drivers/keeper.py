"""What a driver is to be told, and when: its life cycle, and the watchdog over its agent. Pure.

Times are ns of one monotonic clock, that of the driver's process. No clocks of two processes are compared.
"""

from collections.abc import Mapping
from math import hypot
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from maniple.core.messages import Drive, DriverState, Motion
from maniple.core.time import MILLISECOND, SECOND, Duration, Time
from robot_agent.drivers.interface import Capabilities, Step

WATCHDOG: Duration = 300 * MILLISECOND
"""Without an order for so long the robot is stopped."""
ZEROS: Duration = 500 * MILLISECOND
"""How long it is then told to stand, before nothing more is said and the driver is deactivated;"""
ZERO_EVERY: Duration = 50 * MILLISECOND
"""and how often."""
AGAIN: Duration = SECOND
"""A step that has not been taken is asked for again after so long."""
FIRST: Duration = SECOND // 2
"""How long after a failure it is connected again, doubled each time,"""
LONGEST: Duration = 8 * SECOND
"""up to this."""
STAND_WITHIN: Duration = 3 * SECOND
"""At the end: how long the robot is given to stand, before the driver is deactivated all the same;"""
DEACTIVATE_WITHIN: Duration = 3 * SECOND // 2
"""how long that may take;"""
CLOSE_WITHIN: Duration = SECOND // 2
"""and closing it."""

LATE: Duration = WATCHDOG
"""An order that took longer on its way than others is too old to be followed."""
DRIFT = 0.01
"""How much faster than the agent's clock the one here may go."""

STANDS_FOR: Duration = 300 * MILLISECOND
"""A robot stands that has been seen not to move for so long,"""
STILL_MPS, STILL_RADPS = 0.02, 0.02
"""up to these speeds."""

STAND = Drive(u_mps=0.0, w_radps=0.0, active=False)
"""Says also that no controller is known to live."""


class Take(NamedTuple):
    """Ask the driver for a step of its life cycle."""

    step: Step


class Write(NamedTuple):
    """Pass an order on."""

    drive: Drive


class Halt(NamedTuple):
    """Stop the robot at once."""


Action: TypeAlias = Take | Write | Halt

Phase: TypeAlias = Literal["keeping", "standing", "deactivating", "closing", "done"]
"""Whether the driver is kept going, or how far its end has come."""

_UP: Mapping[DriverState, Step] = {
    "closed": "connect",
    "connected": "configure",
    "configured": "activate",
    "fault": "close",
}
_DOWN: Mapping[Phase, Step] = {"deactivating": "deactivate", "closing": "close"}
"""The next step on the way up, from each state, and at the end."""

_CALLED_OFF: Mapping[tuple[DriverState, Step | None], Step] = {
    ("active", "deactivate"): "activate",
    ("configured", "activate"): "deactivate",
}
"""What calls off a step that is under way in the state that is aimed at after all."""


class Keeper:
    """Keeps one driver going. It is told what happens, and says what is due.

    The driver is connected and configured always, active while the agent wants it so. Orders are passed on
    while it is active, clipped to its `capabilities`. Without an order for `WATCHDOG`, or with one that does
    not want it active, it is stopped, told to stand for `ZEROS`, and deactivated; the next order that wants
    it active resumes. From "fault" it is closed and connected anew. Once the end is asked for no order
    counts.
    """

    def __init__(self, capabilities: Capabilities) -> None:
        self._capabilities = capabilities
        self._order: Drive | None = None
        self._heard: Time = 0
        self._fresh = False
        self._drives = False
        self._halted: Time | None = None
        self._zero: Time = 0
        self._state: DriverState = "closed"
        self._asked: Step | None = None
        self._asked_at: Time = 0
        self._failures = 0
        self._retry_at: Time | None = None
        self._phase: Phase = "keeping"
        self._since: Time = 0

    @property
    def done(self) -> bool:
        """Whether the end was asked for, and has come."""
        return self._phase == "done"

    def heard(self, drive: Drive, now: Time) -> None:
        """An order of the agent has arrived."""
        self._order, self._heard, self._fresh = drive, now, True

    def failed(self, now: Time) -> None:
        """The driver did not work, and was stopped and given up: there is another one, closed."""
        self._put_off(now)
        self._changed("closed", now)

    def end(self, now: Time) -> None:
        """Bring everything to its end: let the robot stand, deactivate, close; `done` says when that is."""
        if self._phase == "keeping":
            self._enter("standing", now)
            self._drives = True  # as far as is known: it is stopped in any case

    def due(self, state: DriverState, stands: bool, now: Time) -> list[Action]:
        """What to do now, in this order, with the driver in this state; `stands`: the robot is seen to."""
        if state != self._state:
            self._changed(state, now)
        self._advance(stands, now)
        wants = self._wants(now)
        actions = self._pass_on() if wants and state != "fault" else self._brake(now)
        if (step := self._step(wants, now)) is not None:
            self._asked, self._asked_at = step, now
            actions.append(Take(step))
        return actions

    def _changed(self, state: DriverState, now: Time) -> None:
        if state == "fault":
            self._put_off(now)
        elif state != "active":
            self._drives, self._halted = False, None
        if state in ("configured", "active"):
            self._failures = 0
        self._state, self._asked = state, None

    def _put_off(self, now: Time) -> None:
        """Do not connect again at once."""
        self._retry_at = now + min(FIRST << min(self._failures, 16), LONGEST)
        self._failures += 1

    def _enter(self, phase: Phase, now: Time) -> None:
        self._phase, self._since = phase, now

    def _advance(self, stands: bool, now: Time) -> None:
        """Go on with the end, with patience for each part of it."""
        active = self._state == "active"
        if self._phase == "standing" and (stands or not active or now - self._since >= STAND_WITHIN):
            self._enter("deactivating", now)
        if self._phase == "deactivating" and (not active or now - self._since >= DEACTIVATE_WITHIN):
            self._enter("closing", now)
        if self._phase == "closing" and (self._state == "closed" or now - self._since >= CLOSE_WITHIN):
            self._enter("done", now)

    def _wants(self, now: Time) -> bool:
        """Whether the agent is there, and wants the driver active."""
        order = self._order
        there = order is not None and order.active and now - self._heard < WATCHDOG
        return there and self._phase == "keeping"

    def _pass_on(self) -> list[Action]:
        """Tell the robot what is new; once a deactivation that is under way is called off."""
        if self._state != "active" or self._asked == "deactivate" or not self._fresh:
            return []
        assert self._order is not None
        self._fresh, self._drives, self._halted = False, True, None
        return [Write(clipped(self._order, self._capabilities))]

    def _brake(self, now: Time) -> list[Action]:
        """Stop the robot, if it may be driving, and tell it for a while to stand."""
        actions: list[Action] = []
        self._fresh = False
        if self._drives and self._state in ("active", "fault"):
            self._halted, self._zero = now, now - ZERO_EVERY
            actions.append(Halt())
        self._drives = False
        if self._brakes(now) and now - self._zero >= ZERO_EVERY:
            self._zero = now
            actions.append(Write(STAND))
        return actions

    def _brakes(self, now: Time) -> bool:
        """Whether the robot is being told to stand."""
        if self._state != "active" or self._asked == "deactivate" or self._halted is None:
            return False
        return self._phase == "standing" or (self._phase == "keeping" and now - self._halted < ZEROS)

    def _step(self, wants: bool, now: Time) -> Step | None:
        """The next step of the life cycle, if it is due."""
        step = self._towards(wants, now)
        if step is None:
            return _CALLED_OFF.get((self._state, self._asked)) if self._phase == "keeping" else None
        return step if step != self._asked or now - self._asked_at >= AGAIN else None

    def _towards(self, wants: bool, now: Time) -> Step | None:
        """The next step, due or not; None: the driver is where it is to be."""
        state = self._state
        if self._phase != "keeping":
            return _DOWN.get(self._phase)
        if state == "closed" and self._retry_at is not None and now < self._retry_at:
            return None
        if state == "active":
            return None if wants or self._brakes(now) else "deactivate"
        return None if state == "configured" and not wants else _UP[state]


def clipped(drive: Drive, capabilities: Capabilities) -> Drive:
    """An order as far as a driver can follow it."""
    u_max, w_max, v_max = capabilities.u_max_mps, capabilities.w_max_radps, capabilities.v_max_mps
    return msgspec.structs.replace(
        drive,
        u_mps=min(max(drive.u_mps, -u_max if capabilities.reverse else 0.0), u_max),
        w_radps=min(max(drive.w_radps, -w_max), w_max) if capabilities.accepts_yaw_rate else 0.0,
        v_mps=min(max(drive.v_mps, -v_max), v_max),
    )


class Lateness:
    """How much longer than the fastest of its life a message took: what piled up while this process, or the
    network, stood still is told from what is new."""

    def __init__(self) -> None:
        self._life = 0
        self._least: Duration = 0
        self._arrived: Time = 0

    def of(self, life: int, stamp: Time, arrived: Time) -> Duration:
        """Of a message with this stamp of the sender's clock."""
        offset = arrived - stamp
        risen = self._least + round(DRIFT * (arrived - self._arrived))
        self._least = offset if life != self._life else min(offset, risen)
        self._life, self._arrived = life, arrived
        return offset - self._least


class Standing:
    """Whether a robot is seen to stand, by its motion."""

    def __init__(self) -> None:
        self._last: Motion | None = None
        self._last_at: Time = 0
        self._since: Time = 0

    def take(self, motion: Motion, now: Time) -> None:
        """It has been reported."""
        last, self._last = self._last, motion
        if last is None or now - self._last_at > STANDS_FOR or _moves(motion, last):
            self._since = now
        self._last_at = now

    def holds(self, now: Time) -> bool:
        """Whether it does."""
        heard = self._last is not None and now - self._last_at <= STANDS_FOR
        return heard and now - self._since >= STANDS_FOR


def _moves(motion: Motion, last: Motion) -> bool:
    if motion.pose is None:
        return motion.ticks != last.ticks
    u, w, v = motion.twist
    return hypot(u, v) > STILL_MPS or abs(w) > STILL_RADPS
