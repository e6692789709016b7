"""How far apart two runs may be and still count as the same.

A line of them names a quantity and a field of it: `robot/*/command:values=1e-6`. Names are patterns of levels
as for topics (`*` one level, `**` any number). A field is a path, `*` standing for any part of it, and covers
all that is inside it; indices may be left out: `errors`, `roster.odometry_age_s`, `values[0]`.
"""

import math
import re
import tomllib
from collections.abc import Collection, Iterable
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from maniple.core.errors import ArgumentError
from maniple.recording.selection import matches

_INDEX = re.compile(r"\[\d+\]")


class Rule(NamedTuple):
    """What is said of some fields."""

    name: str
    field: str
    tolerance: float = 0.0


class Tolerances(msgspec.Struct, frozen=True):
    """What two runs may differ in, and how far; of several rules for a field the last counts."""

    default: float | None = None
    """For every number that no rule is for; None: 0."""
    rules: tuple[Rule, ...] = ()
    ignored: tuple[Rule, ...] = ()

    def of(self, name: str, field: str) -> float:
        """The tolerance of a field, absolute, in its unit."""
        found = (r.tolerance for r in reversed(self.rules) if _covers(r.name, r.field, name, field))
        return next(found, self.default or 0.0)

    def ignores(self, name: str, field: str = "") -> bool:
        """Whether a field, or without one everything of that name, is not compared."""
        return any(_covers(rule.name, rule.field, name, field) for rule in self.ignored)

    def and_then(self, later: "Tolerances") -> "Tolerances":
        """These, overruled by others."""
        default = self.default if later.default is None else later.default
        return Tolerances(default, (*self.rules, *later.rules), (*self.ignored, *later.ignored))


def tolerances_of(tolerances: Iterable[str], ignored: Iterable[str]) -> Tolerances:
    """As options give them: `NAME:FIELD=NUMBER`, or a number for all; and `NAME` or `NAME:FIELD`.

    Raises:
        ArgumentError: one is not of that form; says which and what would be.
    """
    default, rules = None, []
    for text in tolerances:
        where, equals, number = text.rpartition("=")
        if equals:
            rules.append(_rule(where, text)._replace(tolerance=_number(number, text)))
        else:
            default = _number(text, text)
    return Tolerances(default, tuple(rules), tuple(_rule(text, text) for text in ignored))


def require_used(tolerances: Tolerances, names: Collection[str]) -> None:
    """Refuse rules for names that there are not.

    Raises:
        ArgumentError: one is for none of these names; lists them.
    """
    for rule in (*tolerances.rules, *tolerances.ignored):
        if not any(matches(rule.name, name) for name in names):
            there = ", ".join(sorted(names)) or "nothing"
            raise ArgumentError(f"{rule.name!r} matches nothing that is compared; there is {there}")


def read_tolerances(path: Path) -> Tolerances:
    """The tolerances in a TOML file: `default`, a number; `ignore`, a list of NAME or NAME:FIELD; and a table
    `[tolerances]` of "NAME:FIELD" = number.

    Raises:
        ArgumentError: it can't be read, or holds something else; names the file.
    """
    try:
        file = msgspec.convert(tomllib.loads(path.read_text("utf-8")), _File)
        limits = {key: _number(value, f"{key} = {value}") for key, value in file.tolerances.items()}
        return Tolerances(
            None if file.default is None else _number(file.default, f"default = {file.default}"),
            tuple(_rule(key, key)._replace(tolerance=limit) for key, limit in limits.items()),
            tuple(_rule(key, key) for key in file.ignore),
        )
    except OSError as error:
        raise ArgumentError(f"{path}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ArgumentError(f"{path}: not UTF-8 text") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ArgumentError(f"{path}: not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise ArgumentError(f"{path}: {error}; valid are default, ignore and [tolerances]") from None
    except ArgumentError as error:
        raise ArgumentError(f"{path}: {error}") from None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    default: float | None = None
    ignore: tuple[str, ...] = ()
    tolerances: dict[str, float] = {}


def _rule(where: str, text: str) -> Rule:
    name, colon, field = where.partition(":")
    if not name or (colon and not field):
        raise ArgumentError(f"{text!r}: must begin with NAME or NAME:FIELD, as robot/*/command:values")
    matches(name, "")  # refuses what can't match anything
    return Rule(name, field)


def _number(value: str | float, text: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not number >= 0:
        raise ArgumentError(
            f"tolerance {text!r}: must be a number from 0, as 1e-6, or NAME:FIELD=NUMBER, as "
            "robot/*/command:values=1e-6"
        )
    return number


@lru_cache(65536)
def _covers(pattern: str, inside: str, name: str, field: str) -> bool:
    """Whether a rule is for a field of a name; a rule with a field is not for a name as a whole."""
    if not matches(pattern, name):
        return False
    if not inside:
        return True
    if "[" not in inside:
        field = _INDEX.sub("", field)
    parts = re.split(r"(?=[.\[])", field)
    return any(
        fnmatchcase("".join(parts[:count]), inside.replace("[", "[[]")) for count in range(1, len(parts) + 1)
    )
