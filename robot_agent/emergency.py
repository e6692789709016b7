"""Whether operators let the robot move."""

from typing import Literal, TypeAlias

from maniple.core.messages import EmergencyStop

Change: TypeAlias = Literal["emergency", "armed"]
"""It has to stand from now on; or it may move again."""

_LONGEST = 200
"""Characters of an operator's reason that are passed on."""


class Emergency:
    """The last word of the operators. Of several that of the largest (incarnation, seq) counts, whoever it is
    from and in whatever order they arrive: so all robots come to the same, and what the router keeps."""

    def __init__(self) -> None:
        self._last: EmergencyStop | None = None

    @property
    def stopped(self) -> bool:
        """Whether the robot has to stand."""
        return self._last is not None and self._last.stopped

    @property
    def reason(self) -> str:
        """Why it has to, for people; one line."""
        said = self._last
        if said is None or not said.stopped:
            return ""
        text = " ".join(said.reason.split())[:_LONGEST]
        return f"emergency stop: {text}" if text else "emergency stop"

    def take(self, said: EmergencyStop) -> Change | None:
        """Listen to an operator; None if that changes nothing."""
        last, before = self._last, self.stopped
        if last is not None and (said.incarnation, said.seq) <= (last.incarnation, last.seq):
            return None
        self._last = said
        if said.stopped == before:
            return None
        return "emergency" if said.stopped else "armed"
