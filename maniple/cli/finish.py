"""The end of a run that nobody supervises: waits until the task is done, then ends all processes in order."""

import threading
import time
from collections.abc import Callable

from maniple.cli.nodes import RUNDOWN_S
from maniple.cli.processes import stop_order
from maniple.core import codec, topics
from maniple.core.errors import MessageError, RunError
from maniple.core.messages import FormationState
from maniple.core.scenario.types import Scenario
from maniple.host.ending import ask_to_end
from maniple.transport.zenoh import ZenohSession

POLL_S = 0.5
SIMULATOR_GONE_S = 30.0
"""A simulator that is away for longer is not frozen but dead, and with it the world of the run."""
END_EACH_S = 10.0
"""How long those that are ended together are waited for; what is frozen is left behind."""


class Finisher:
    """Watches a run from the fleet network and the hardware one, which may be the same; `say` is told."""

    def __init__(
        self, scenario: Scenario, fleet: ZenohSession, hardware: ZenohSession, say: Callable[[str], None]
    ) -> None:
        self._order = tuple(stop_order(scenario).values())
        self._fleet = fleet
        self._sessions = (fleet,) if hardware is fleet else (fleet, hardware)
        self._say = say
        self._phase = ""
        self.worlds: set[int] = set()
        """The lives of the simulator that were there."""
        self._interrupted = threading.Event()

    def interrupt(self) -> None:
        """Make `run` return and leave everything as it is; safe from a signal handler."""
        self._interrupted.set()

    def run(self, limit_s: float) -> bool:
        """Wait for the end of the task, then end everybody. False: interrupted.

        Raises:
            RunError: the task was not done within `limit_s` of wall time, or its world is gone. Everybody is
                ended all the same.
        """
        self._fleet.subscribe(topics.FORMATION_STATE, self._arrived)
        for topic, data in self._fleet.ask(topics.FORMATION_STATE).items():
            self._arrived(topic, data)
        failure = self._wait(limit_s)
        if self._interrupted.is_set():
            return False
        self._say(failure or "the task is done")
        for names in self._order:
            self._end(set(names))
        if failure:
            raise RunError(failure)
        return True

    def _arrived(self, topic: str, data: bytes) -> None:
        try:
            state = codec.decode(topic, data)
        except MessageError:
            return
        if isinstance(state, FormationState):
            self._phase = state.phase

    def _wait(self, limit_s: float) -> str | None:
        """Returns why the run is over before the task is done; None where that, or an interrupt, ended it."""
        begin = seen = time.monotonic()
        told = ""
        while self._phase != "done" and not self._interrupted.wait(POLL_S):
            if self._phase not in (told, "done"):
                told = self._phase
                self._say(f"the platoon is {told}")
            now = time.monotonic()
            here = self._here()
            self.worlds.update(here.get("simulator", ()))
            if "simulator" in here or not self.worlds or "router" not in here:
                seen = now
            if len(self.worlds) > 1:
                return "the simulator was started again, which is another world"
            if now - seen > SIMULATOR_GONE_S:
                return f"the simulator has been gone for {SIMULATOR_GONE_S:g} s"
            if now - begin > limit_s:
                return f"the task was not done within {limit_s:.0f} s"
        return None

    def _end(self, names: set[str]) -> None:
        """End those of them that are there, and wait for that."""
        if "simulator" in names:
            self._interrupted.wait(RUNDOWN_S)  # the recording is to show the robots stand
        until = time.monotonic() + END_EACH_S
        while left := sorted(names & self._here().keys()):
            if time.monotonic() > until:
                self._say(f"left behind: {', '.join(left)}")
                return
            for name in left:
                for session in self._sessions:
                    ask_to_end(session, name)
            self._interrupted.wait(POLL_S)

    def _here(self) -> dict[str, tuple[int, ...]]:
        """The lives of every node, on either network."""
        found: dict[str, tuple[int, ...]] = {}
        for session in self._sessions:
            for node, lives in session.everyone().items():
                found[node] = (*found.get(node, ()), *lives)
        return found
