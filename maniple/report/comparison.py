"""Two runs side by side: the same quantities over time and the figures of both, and how far they are apart.

Time counts from when the platoon set out: the controller had seen every robot. In virtual time that is at the
same moment in every run of a scenario; real processes take their time to start.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np

from maniple.core.geometry import Floats, wrap_array
from maniple.core.messages import Command
from maniple.core.scenario.types import Scenario
from maniple.recording.reader import Recording
from maniple.report.comparison_tolerances import Tolerances
from maniple.report.samples import Samples, Track, seconds
from maniple.report.series import Series
from maniple.report.summary import RunFigures, magnitudes
from maniple.report.true_time import TrueTime, epoch_of

ERRORS = ("position_m", "orientation_rad", "distance_m", "angle_rad")
"""The four kinds of formation errors, the largest over the triangles."""

OUTCOME = "outcome"
"""What the figures of a run are called in tolerances, as in `outcome:final_error.position_m`."""


class Pair(NamedTuple):
    """The same quantities of two runs over time, s since the platoon set out."""

    name: str
    """As in tolerances: "robot/r1/drive"."""
    fields: tuple[str, ...]
    """Of the columns, with their units at the end."""
    a: Track
    b: Track


class Apart(msgspec.Struct, frozen=True):
    """How far a quantity of two runs is apart over the time that both have it."""

    name: str
    field: str
    samples: int
    """Of A, that B was compared with; where B lies between two samples it is interpolated."""
    largest: float | None = None
    """Largest |A - B|; None where there was nothing to compare."""
    at_s: float | None = None
    """When that was."""
    a: float | None = None
    b: float | None = None
    """The values then."""
    rms: float | None = None
    mean: float | None = None
    """Of A - B."""
    tolerance: float = 0.0
    within: bool = True
    only: str = ""
    """"A" or "B" where the other has no such quantity."""


class FigureRow(msgspec.Struct, frozen=True):
    """One figure of both runs."""

    field: str
    """"final_error.position_m"."""
    a: Any
    b: Any
    difference: float | None
    """B - A; None where they are no numbers."""
    tolerance: float = 0.0
    within: bool = True


class FieldChange(msgspec.Struct, frozen=True):
    """A field that two scenarios do not share."""

    field: str
    """As `--set` names it: "controller.kappa"."""
    a: Any
    b: Any
    """None where there is none."""


def outcome_rows(a: RunFigures, b: RunFigures, tolerances: Tolerances) -> tuple[FigureRow, ...]:
    """The figures of two runs, one by one; those that are ignored are left out."""
    left, right = _leaves(msgspec.to_builtins(a)), _leaves(msgspec.to_builtins(b))
    rows = []
    for field in dict.fromkeys((*left, *right)):
        if tolerances.ignores(OUTCOME, field):
            continue
        one, other = left.get(field), right.get(field)
        difference = None
        if isinstance(one, int | float) and isinstance(other, int | float) and not isinstance(one, bool):
            difference = float(other - one)
        tolerance = tolerances.of(OUTCOME, field)
        within = one == other or (difference is not None and abs(difference) <= tolerance)
        rows.append(FigureRow(field, one, other, difference, tolerance, within))
    return tuple(rows)


def scenario_changes(a: Scenario, b: Scenario) -> tuple[FieldChange, ...]:
    """The fields in which two scenarios differ, in the order of the scenario."""
    return tuple(_changes(msgspec.to_builtins(a), msgspec.to_builtins(b), ""))


Quantities: TypeAlias = Mapping[str, tuple[tuple[str, ...], Track]]
"""Fields and values over time, by name."""


def pairs_of(a: Quantities, b: Quantities) -> tuple[Pair, ...]:
    """The quantities of two runs side by side, without those that have other fields in each: commands for
    another layer."""
    pairs = []
    for name, (fields, _) in {**a, **b}.items():
        if a.get(name, (fields,))[0] != fields:
            continue
        none = Track(np.empty(0), np.empty((0, len(fields))))
        pairs.append(Pair(name, fields, *(side[name][1] if name in side else none for side in (a, b))))
    return tuple(pairs)


def quantities(recording: Recording, series: Series) -> Quantities:
    """What moves in a run, what it was told to, and what the controller made of it, over the time since the
    platoon set out; what a recording does not hold is left out.

    Raises:
        RecordingError: it is damaged.
    """
    begin = set_out_s(series)
    commands: defaultdict[str, Samples] = defaultdict(lambda: Samples(2))
    layers: dict[str, tuple[str, ...]] = {}
    true_time = TrueTime(series.scenario, epoch_of(recording))
    for record, command in recording.decoded(Command):
        layers[record.topic] = command_fields(command)
        commands[record.topic].add(true_time.of(command).stamp_ns, command.values)
    found: dict[str, tuple[tuple[str, ...], Track]] = {
        "formation/error": (ERRORS, error_track([one.true for one in series.triangles])),
        "formation/estimate": (ERRORS, error_track([one.seen for one in series.triangles])),
        "formation/rate": (("rate",), series.rate),
    }
    for robot in series.robots:
        found |= {
            f"robot/{robot.id}/pose": (("x_m", "y_m", "psi_rad"), robot.poses),
            f"robot/{robot.id}/velocity": (("u_mps", "w_radps", "v_mps"), robot.real),
            f"robot/{robot.id}/drive": (("u_mps", "w_radps", "v_mps"), robot.commanded),
            f"robot/{robot.id}/clearance": (("distance_m",), robot.clearance),
            f"robot/{robot.id}/command_age": (("latest_s", "largest_s"), robot.age),
        }
    for topic, samples in sorted(commands.items()):
        stamps, values = samples.arrays()
        found[topic] = layers[topic], Track(seconds(stamps, series.begin), values)
    return {
        name: (fields, Track(track.t - begin, track.values))
        for name, (fields, track) in found.items()
        if len(track.t)
    }


def command_fields(command: Command) -> tuple[str, str]:
    """What the two values of a command are."""
    return ("vx_mps", "vy_mps") if command.layer == "kinematics" else ("u_mps", "w_radps")


def set_out_s(series: Series) -> float:
    """When the controller had seen every robot, s since the series begins; 0 where it never had."""
    return next((span.begin for span in series.phases if span.what != "waiting"), 0.0)


def error_track(triangles: Sequence[Track]) -> Track:
    """The four kinds of errors over time, at each time the largest over the triangles that are there then."""
    parts = [(track.t, magnitudes(track.values[:, None])) for track in triangles if len(track.t)]
    if not parts:
        return Track(np.empty(0), np.empty((0, 4)))
    times, place = np.unique(np.concatenate([t for t, _ in parts]), return_inverse=True)
    largest = np.full((len(times), 4), -np.inf)
    np.maximum.at(largest, place, np.concatenate([values for _, values in parts]))
    return Track(times, largest)


def apart(pairs: Iterable[Pair], tolerances: Tolerances) -> Iterator[Apart]:
    """How far each quantity is apart; those that are ignored are left out."""
    for pair in pairs:
        for column, field in enumerate(pair.fields):
            if not tolerances.ignores(pair.name, field):
                yield _apart(pair, column, field, tolerances.of(pair.name, field))


def difference(pair: Pair, column: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Times at which both have this quantity, its values there, and A - B, each (k,): at the samples of A, or
    of B where those are denser. Angles are wrapped."""
    one, other = _column(pair.a, column), _column(pair.b, column)
    if not (len(one.t) and len(other.t)):
        return (np.empty(0),) * 4
    swapped = len(other.t) > len(one.t)
    dense, sparse = (other, one) if swapped else (one, other)
    inside = (dense.t >= sparse.t[0] - _SAME_S) & (dense.t <= sparse.t[-1] + _SAME_S)
    t, values = dense.t[inside], dense.values[inside, 0]
    angle = pair.fields[column] == "psi_rad"
    base = _unwrapped(sparse.values[:, 0]) if angle else sparse.values[:, 0]
    matched = base if np.array_equal(t, sparse.t) else np.interp(t, sparse.t, base)
    known = np.isfinite(values) & np.isfinite(matched)
    t, values, matched = t[known], values[known], matched[known]
    a, b = (matched, values) if swapped else (values, matched)
    off = wrap_array(a - b) if angle else a - b
    return t, a, b, off


_SAME_S = 1e-6
"""Times nearer than this are the same."""


def _apart(pair: Pair, column: int, field: str, tolerance: float) -> Apart:
    t, a, b, off = difference(pair, column)
    if not len(t):
        only = "A" * bool(len(pair.a.t) and not len(pair.b.t)) or "B" * bool(
            len(pair.b.t) and not len(pair.a.t)
        )
        return Apart(pair.name, field, 0, tolerance=tolerance, within=False, only=only)
    worst = int(np.abs(off).argmax())
    largest = float(abs(off[worst]))
    return Apart(
        name=pair.name,
        field=field,
        samples=len(t),
        largest=largest,
        at_s=float(t[worst]),
        a=float(a[worst]),
        b=float(b[worst]),
        rms=float(np.sqrt(np.mean(off**2))),
        mean=float(np.mean(off)),
        tolerance=tolerance,
        within=largest <= tolerance,
    )


def _column(track: Track, column: int) -> Track:
    """One column without the breaks of its line at its ends."""
    values = track.values[:, column : column + 1]
    known = np.flatnonzero(np.isfinite(values[:, 0]))
    span = slice(known[0], known[-1] + 1) if len(known) else slice(0)
    return Track(track.t[span], values[span])


def _unwrapped(angles: Floats) -> Floats:
    """Angles without jumps; NaN stays."""
    known = np.isfinite(angles)
    found = angles.copy()
    found[known] = np.unwrap(angles[known])
    return found


def _leaves(data: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """What is in tables within tables, by dotted paths."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        found |= _leaves(value, f"{path}{key}.") if isinstance(value, dict) else {f"{path}{key}": value}
    return found


def _changes(a: Any, b: Any, path: str) -> Iterator[FieldChange]:
    """In what two values differ, by paths as `--set` has them: entries with an id are named by it."""
    one, other = _parts(a), _parts(b)
    if one is None or other is None:
        if a != b:
            yield FieldChange(path, a, b)
        return
    for key in {**one, **other}:
        yield from _changes(one.get(key), other.get(key), f"{path}.{key}" if path else key)


def _parts(value: Any) -> Mapping[str, Any] | None:
    """The entries of a table or a list by their names; None for what has none."""
    if isinstance(value, dict):
        return value
    if not isinstance(value, list | tuple):
        return None
    ids = [entry.get("id") if isinstance(entry, dict) else None for entry in value]
    named = all(ids) and len(set(ids)) == len(ids)
    return {str(name): entry for name, entry in zip(ids if named else range(len(value)), value, strict=True)}
