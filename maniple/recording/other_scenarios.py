"""Which nodes ran another scenario than the one in the recording, by their journals."""

from maniple.core.messages import Journal
from maniple.core.scenario.parse import digest_of

OTHERS_NAME = "maniple.other_scenarios"
"""The metadata record of a recording in which there are some: digest by "NODE (life N)"."""

_SHOWN = 16
"""Digits of a digest that people are shown."""


class OtherScenarios:
    """Listens to journals; `scenario_json` is the scenario of the recording."""

    def __init__(self, scenario_json: bytes) -> None:
        self._own = digest_of(scenario_json)
        self.found: dict[str, str] = {}
        """The digest of the other scenario by "NODE (life N)"."""

    def heard(self, journal: Journal) -> str:
        """What there is to say of a life that begins with this one, for people; empty for nothing new."""
        first = next(iter(journal.calls), None)
        if first is None or first.kind != "start" or first.name in ("", self._own):
            return ""
        who = f"{journal.source} (life {journal.incarnation})"
        if self.found.get(who) == first.name:
            return ""
        self.found[who] = first.name
        return self._text(who, first.name)

    @property
    def texts(self) -> tuple[str, ...]:
        """A line for each."""
        return tuple(self._text(*one) for one in self.found.items())

    def _text(self, who: str, digest: str) -> str:
        return f"{who} runs another scenario ({digest[:_SHOWN]}) than the recorder's ({self._own[:_SHOWN]})"
