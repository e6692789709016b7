"""What a simulated body owes the process that shows it as a vehicle."""

from typing import Protocol

from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import MILLISECOND, Duration, Time

STEP: Duration = 20 * MILLISECOND
"""How often a vehicle is given the word: ArduPilot Rover's own loop runs at 50 Hz too."""


class Vehicle(Protocol):
    """The electronics of a vehicle around a simulated body: on one side a protocol that drivers of real ones
    speak, on the other the body's drive and what its sensors say.

    It is an edge component: it may do I/O. One thread calls it, with the time of the run (ns); no call
    blocks.
    """

    @property
    def refused(self) -> int:
        """What came over its protocol since it was opened and was not understood, or not obeyed."""
        ...

    def open(self, now: Time) -> None:
        """Switch it on: from now on others can reach it.

        Raises:
            ManipleError: it can't be reached where it is to be, or something is not installed.
        """
        ...

    def see(self, report: Motion | Scan, now: Time) -> None:
        """Take in what the body reports: how it moves (`Motion.pose` in the world frame and `twist` are true,
        of the middle of the axle), or what its range finder sees."""
        ...

    def step(self, now: Time) -> Drive:
        """Take in what came over its protocol since the last step, say what is due, and tell the body what to
        do. Called every `STEP`; after a freeze what was missed is skipped."""
        ...

    def close(self, now: Time, /) -> None:
        """Switch it off. May be called in any state."""
        ...


class VehicleFactory(Protocol):
    """Makes the vehicle of a robot of a resolved scenario. It does no I/O and imports nothing heavy.
    `endpoint` is the router of the hardware network, empty where there is none yet."""

    def __call__(self, scenario: Scenario, robot: Robot, endpoint: str = "", /) -> Vehicle:
        """Raises `ScenarioError` where the robot's parameters are not valid, with what would be."""
        ...
