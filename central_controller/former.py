"""What the life of the controller before this one left on the network, and whether it is enough to go on."""

from collections.abc import Sequence
from typing import NamedTuple

from maniple.core.messages import FormationState, Goal, Mission, Progress


class Record(NamedTuple):
    """All that is needed to go on."""

    mission: Mission
    state: FormationState
    progress: Progress


class FormerLife:
    """Gathers the last `Mission` and the last `FormationState` of earlier lives than `incarnation`, and the
    goal that comes meanwhile. `robots` are those of the scenario."""

    def __init__(self, incarnation: int, robots: Sequence[str]) -> None:
        self._incarnation = incarnation
        self._robots = tuple(robots)
        self._mission: Mission | None = None
        self._state: FormationState | None = None
        self.goal: Goal | None = None

    def heard(self, message: Mission | FormationState | Goal) -> None:
        """One of these arrived; what is older than what is known, or one's own, says nothing."""
        if isinstance(message, Goal):
            self.goal = message
        elif message.incarnation >= self._incarnation:
            return
        elif isinstance(message, Mission):
            if self._mission is None or _order(message) >= _order(self._mission):
                self._mission = message
        elif self._state is None or _order(message) >= _order(self._state):
            self._state = message

    def record(self) -> Record | None:
        """All that is needed, if it is there: both messages, and of the same time.

        A controller sends a new mission before the state that belongs to it, and may die in between. Then the
        mission itself says how far things were.
        """
        mission, state = self._mission, self._state
        if mission is None or state is None or not self._fits(mission):
            return None
        last = (mission.incarnation, mission.number)
        of_state = (state.incarnation, state.mission)
        if of_state > last:
            return None
        return Record(mission, state, state.progress if of_state == last else mission.progress)

    def _fits(self, mission: Mission) -> bool:
        names = tuple(seat.id for seat in mission.seats)
        return names == self._robots and sorted(seat.place for seat in mission.seats) == list(
            range(len(names))
        )

    @property
    def missing(self) -> str:
        """What is known where that is not enough, for people."""
        if (state := self._state) is not None:
            x, y, _ = state.reference
            return (
                f"only that the reference was at ({x:.1f}, {y:.1f}), {state.task_time_s:.0f} s into its task"
            )
        return "nothing" if self._mission is None else "only the task, not how far it is"


def _order(message: Mission | FormationState) -> tuple[int, int]:
    return message.incarnation, message.seq
