"""What `maniple fault set` refuses beyond what a scenario may say, and how its options are told."""

import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, TypeVar

from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.faults import matches
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Fault, Parameters
from maniple.core.topics import TOPICS, sender_of

P = TypeVar("P", bound=Parameters)

OBSERVERS = ""
"""The destination of what the controller tells whoever listens."""

_PATH = re.compile(r"^(?:faults\[\d+\]\.)?([a-z_]+(?:\.[a-z_]+)*)(?:\[\d+\])*(?= = |: )")
_NAMES = {
    "source": "--from",
    "destination": "--to",
    "windows": "--window",
    "reorder_s": "--reorder-by",
    "node": "NODE",
    "groups": "GROUP",
}


class Link(NamedTuple):
    """Where messages go that faults apply to."""

    source: str
    destination: str
    topic: str


def links(robots: Sequence[str]) -> Iterator[Link]:
    """All links of a platoon of these robots: between each of them and the controller, from operators to it,
    and from it to observers."""
    for row in TOPICS:
        for robot in (robots if "{id}" in row.pattern else ("",)) if row.faults else ():
            topic = row.pattern.replace("{id}", robot)
            source = sender_of(topic) or "operator"
            yield Link(source, robot if source == "controller" else "controller", topic)


def link_problem(rule: Fault, robots: Sequence[str]) -> str:
    """Why no message ever goes where a rule says, and where messages go; empty if some do. Where observers
    are is not known: a rule for them names what they read."""
    if any(_is_on(rule, link) for link in links(robots)):
        return ""
    given = (("--from", rule.source), ("--to", rule.destination), ("--topic", rule.topic))
    said = " ".join(f"{option} {value}" for option, value in given if value != "*")
    return f"{said}: no message goes that way; valid: {_directions()}"


def effect_problem(rule: Fault, given: Mapping[str, Any]) -> str:
    """What a rule lacks to inject anything, or for what was `given` for it to count; empty if nothing.
    The rule has the numbers of its preset."""
    if "reorder_s" in given and not rule.reorder:
        return "--reorder-by: says for how long, not how many; give --reorder too"
    if "queue_s" in given and rule.rate_kbps is None:
        return "--queue: is for what comes faster than a rate; give --rate-kbps too"
    if _injects(rule):
        return ""
    names = ", ".join(dict.fromkeys(map(option, _leaves(given))))
    return f"{names}: nothing is injected with that; give a number above 0, or use clear to take a rule back"


def parsed(kind: type[P], data: Mapping[str, Any]) -> P:
    """The parameters that options describe.

    Raises:
        ArgumentError: a line for each option that is wrong.
    """
    try:
        return parameters_of(kind, data)
    except ScenarioError as error:
        raise ArgumentError("\n".join(map(by_option, str(error).splitlines()))) from None


def by_option(problem: str) -> str:
    """A problem of a rule, or of what a command was given, in terms of options."""
    return _PATH.sub(lambda found: option(found[1]), problem)


def option(field: str) -> str:
    """The option for a field of a rule."""
    return _NAMES.get(field) or "--" + field.removesuffix("_s").replace("_", "-").replace(".", "-")


def _is_on(rule: Fault, link: Link) -> bool:
    if link.destination == OBSERVERS:
        named = rule.topic != "*" and fnmatchcase(link.topic, rule.topic)
        return named and fnmatchcase(link.source, rule.source)
    return matches(rule, *link)


def _directions() -> str:
    """The links of any platoon, in words."""
    ways: dict[tuple[str, str], list[str]] = {}
    for link in links(["ID"]):
        ways.setdefault((link.source, link.destination), []).append(link.topic)
    names = {"ID": "a robot", OBSERVERS: "observers"}
    return "; ".join(
        f"{names.get(source, source)} to {names.get(destination, destination)} on {', '.join(topics)}"
        for (source, destination), topics in ways.items()
    )


def _injects(rule: Fault) -> bool:
    burst = rule.burst
    return bool(
        rule.latency_s
        or rule.jitter_s
        or rule.loss
        or (burst is not None and (burst.loss_good or (burst.enter and burst.loss_bad)))
        or rule.duplicate
        or (rule.reorder and rule.reorder_s)
        or rule.corrupt
        or rule.rate_kbps is not None
    )


def _leaves(given: Mapping[str, Any], path: str = "") -> Iterator[str]:
    for name, value in given.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{name}.")
        else:
            yield path + name
