"""A recording as arrays over time: everything that a report shows, and nothing about how.

Times are in s since `Series.begin`. What a recording does not hold is empty, never made up.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from maniple.control.limits import age_limits
from maniple.core import topics
from maniple.core.edges import WORLD
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.faults import plan_of
from maniple.core.geometry import Floats
from maniple.core.messages import (
    Decisions,
    Drive,
    EmergencyStop,
    FaultPlan,
    FormationState,
    Goal,
    Journal,
    Message,
    Odometry,
    Scan,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, to_seconds
from maniple.recording.reader import Recorded, Recording
from maniple.report.delivery import Delivery, Share
from maniple.report.links import LinkTotals
from maniple.report.samples import Samples, Track, seconds, with_gaps
from maniple.report.summary import RunFigures, Summary, under_way
from maniple.report.timeline import Event, Injected, Span, events_of, injected_of, spans_of
from maniple.report.true_time import TrueTime, epoch_of
from maniple.report.truth import (
    Ground,
    Stretch,
    control_points,
    estimated_poses,
    frame_of_odometry,
    ground_of,
    origin_of,
    stretches,
    unwrapped,
)

STATE_GAP_S = topics.topic(topics.FORMATION_STATE).stale_after_s
"""Longer without a word from the controller, and a line is broken."""

STATUS_GAP_S = 2 * topics.topic(topics.status("x")).stale_after_s


class Triangle(NamedTuple):
    """The errors of one triangle (columns x, y, psi_F, p, q, beta; m and rad), desired minus actual."""

    robots: tuple[str, ...]
    seen: Track
    """As the controller sees them."""
    true: Track
    """Ground truth."""


class Snapshot(NamedTuple):
    """The platoon at one moment."""

    name: str
    t: float
    poses: Floats
    """(n, 3): middle of the axle in the world."""
    points: Floats
    """(n, 2): control points."""
    triangles: tuple[tuple[int, int, int], ...]
    """Robots of each triangle, by index."""


class RobotSeries(NamedTuple):
    """What is known of one robot over time."""

    id: str
    true: bool
    """Whether there is ground truth of it; else poses and velocities are what it believes."""
    poses: Track
    """Middle of the axle in the world (m, m, rad): ground truth, or odometry where there is none."""
    commanded: Track
    """(u, w, v) that its drive was told, after the guard."""
    real: Track
    """(u, w, v): ground truth, or what its encoders say where there is none."""
    clearance: Track
    """(m): smallest distance to anything since the sample before."""
    age: Track
    """(now, largest since the sample before): age of what its command was computed from, s."""
    hold_s: float
    """Commands older than this slow it down."""
    stop_s: float
    """At this age it stands."""
    modes: tuple[Span, ...]
    """By its own account."""
    lost: tuple[Span, ...]
    """While the controller has given it up."""
    waited_for: tuple[Span, ...]
    """While the reference waits for it."""
    compensation: Track
    """The adapted parameters th1 .. th6; empty without compensation."""


class Series(NamedTuple):
    """All that a report shows."""

    scenario: Scenario
    figures: RunFigures
    begin: Time
    """Stamp of time 0."""
    end_s: float
    true: bool
    """Whether there is ground truth of any robot."""
    robots: tuple[RobotSeries, ...]
    triangles: tuple[Triangle, ...]
    snapshots: tuple[Snapshot, ...]
    """Start, most deformed, end; fewer where the recording has no such moment."""
    path: Floats
    """(k, 2): way of the desired formation's origin in the world; NaN where it jumps."""
    phases: tuple[Span, ...]
    notes: tuple[Span, ...]
    """What the supervisor did."""
    rate: Track
    """How fast the reference moved along the task, 0 to 1."""
    contacts: tuple[tuple[float, str], ...]
    """Onsets of contact: when, and who."""
    links: tuple[LinkTotals, ...]
    shares: tuple[Share, ...]
    """By kind of message, the share that was delivered over time."""
    events: tuple[Event, ...]
    injected: tuple[Injected, ...]
    """When which faults were on."""
    task_share: float
    """How much of the task's time the reference has covered at the end."""
    last_state: FormationState | None
    unreadable: dict[str, int]
    """Messages that are no valid ones of their topic, by topic."""


def series_of(recording: Recording) -> Series:
    """Read all of a recording.

    Raises:
        RecordingError: it is damaged, or its scenario can't be read.
    """
    virtual = recording.metadata.get("mode") == "virtual"
    reader = _Reader(recording.scenario, epoch_of(recording), virtual)
    for record in recording.messages():
        reader.add(record)
    return reader.series()


class _Reader:
    """Gathers messages, then makes arrays of them."""

    def __init__(self, scenario: Scenario, epoch: Time, virtual: bool) -> None:
        self._scenario = scenario
        self._ids = tuple(robot.id for robot in scenario.robots)
        self._summary = Summary(scenario, epoch)
        self._true_time = TrueTime(scenario, epoch)
        self._delivery = Delivery()
        self._truth: list[Truth] = []
        self._states: list[FormationState] = []
        self._odometry: defaultdict[str, Samples] = defaultdict(lambda: Samples(6))
        self._in_world: set[str] = set()
        self._drives: defaultdict[str, Samples] = defaultdict(lambda: Samples(3))
        self._statuses: defaultdict[str, list[Status]] = defaultdict(list)
        self._goals: list[Goal] = []
        self._stops: list[EmergencyStop] = []
        self._plans: list[FaultPlan] = []
        self._unsaid = [plan_of(scenario, epoch)] if virtual else []
        self._unreadable: Counter[str] = Counter()
        self._handlers: dict[type[Message], Callable[[Any], None]] = {
            Truth: self._truth.append,
            FormationState: self._states.append,
            Odometry: self._add_odometry,
            Drive: lambda m: self._drives[m.source].add(m.stamp_ns, (m.u_mps, m.w_radps, m.v_mps)),
            Status: lambda m: self._statuses[m.source].append(m),
            Goal: self._goals.append,
            EmergencyStop: self._stops.append,
            FaultPlan: self._plans.append,
            Journal: self._delivery.journal,
            Decisions: self._delivery.decisions,
        }

    def add(self, record: Recorded) -> None:
        """Take a message in; what is sensed is not decoded."""
        try:
            row = topics.topic(record.topic)
            if row.faults:
                header = header_of(record.topic, record.data)
                self._delivery.sent(record.topic, self._true_time.header(header))
            if row.type is Scan:
                return
            message = record.decode()
        except MessageError:
            self._unreadable[record.topic] += 1
            return
        self._summary.add(message)
        message = self._true_time.of(message)
        if handler := self._handlers.get(type(message)):
            handler(message)

    def _add_odometry(self, m: Odometry) -> None:
        values = (m.x_m, m.y_m, m.psi_rad, m.u_mps, m.w_radps, m.v_mps)
        self._odometry[m.source].add(m.stamp_ns, values)
        if m.frame_id == WORLD:
            self._in_world.add(m.source)

    def series(self) -> Series:
        """All of it as arrays."""
        stamp = attrgetter("stamp_ns")
        self._truth.sort(key=stamp)
        self._states.sort(key=stamp)
        for statuses in self._statuses.values():
            statuses.sort(key=stamp)
        begin, end = self._times()
        end_s = to_seconds(end - begin)
        ground = ground_of(self._truth, self._scenario)
        running = under_way(self._states)
        true = stretches(ground, [m for m in self._states if m.phase != "waiting"], self._scenario)
        robots = tuple(self._robot(index, ground, begin, end_s) for index in range(len(self._ids)))
        counted = [m.task_time_s / m.task_duration_s for m in self._states[-1:] if m.task_duration_s > 0]
        return Series(
            scenario=self._scenario,
            figures=self._summary.figures(),
            begin=begin,
            end_s=end_s,
            true=bool(self._truth),
            robots=robots,
            triangles=_triangles(self._states, true, begin),
            snapshots=self._snapshots(robots, true, running, begin),
            path=_path(self._states, self._scenario),
            phases=spans_of(((m.stamp_ns, m.phase) for m in self._states), begin, end_s, STATE_GAP_S),
            notes=spans_of(
                ((m.stamp_ns, "; ".join(m.supervisor)) for m in self._states), begin, end_s, STATE_GAP_S
            ),
            rate=with_gaps(
                _track(((m.stamp_ns, (m.rate,)) for m in running if m.phase != "done"), 1, begin), STATE_GAP_S
            ),
            contacts=_contacts(self._truth, begin),
            links=tuple(self._delivery.links.links()),
            shares=self._delivery.shares(begin),
            events=events_of(
                self._states,
                self._goals,
                _contacts(self._truth, begin),
                begin,
                self._stops,
                self._plans or self._unsaid,
                end,
            ),
            injected=injected_of(self._plans or self._unsaid, begin, end),
            task_share=min(counted[0], 1.0) if counted else 0.0,
            last_state=self._states[-1] if self._states else None,
            unreadable=dict(sorted(self._unreadable.items())),
        )

    def _times(self) -> tuple[Time, Time]:
        """First and last stamp of what moves or speaks; both 0 for an empty recording."""
        moments = [m.stamp_ns for group in (self._truth, self._states) for m in (*group[:1], *group[-1:])]
        for statuses in self._statuses.values():
            moments += [statuses[0].stamp_ns, statuses[-1].stamp_ns]
        for samples in (*self._odometry.values(), *self._drives.values()):
            stamps, _ = samples.arrays()
            moments += [int(stamps[0]), int(stamps[-1])]
        return min(moments, default=0), max(moments, default=0)

    def _robot(self, index: int, ground: Ground, begin: Time, end_s: float) -> RobotSeries:
        robot = self._scenario.robots[index]
        name = robot.id
        statuses = self._statuses[name]
        known = np.isfinite(ground.poses[:, index, 0])
        t = seconds(ground.stamps[known], begin)
        poses = Track(t, ground.poses[known, index])
        real = Track(t, ground.velocities[known, index])
        if not len(t):
            stamps, rows = self._odometry[name].arrays()
            origin = frame_of_odometry(robot, name in self._in_world)
            believed = estimated_poses(origin, unwrapped(rows[:, :3]))
            poses = Track(seconds(stamps, begin), believed)
            real = Track(poses.t, rows[:, 3:])
        drive_t, drives = self._drives[name].arrays()
        hold_s, stop_s = age_limits(self._scenario, robot)
        ages = [
            (m.stamp_ns, (m.command_age_s, m.command_age_max_s)) for m in statuses if m.command_age_s >= 0
        ]
        lost = ((m.stamp_ns, "lost" * _is_lost(m, name)) for m in self._states)
        waited = ((m.stamp_ns, "waited for" * (name in m.waits_for)) for m in self._states)
        modes = ((m.stamp_ns, m.mode) for m in statuses)
        return RobotSeries(
            id=name,
            true=bool(len(t)),
            poses=with_gaps(poses, STATE_GAP_S),
            commanded=with_gaps(Track(seconds(drive_t, begin), drives), STATE_GAP_S),
            real=with_gaps(real, STATE_GAP_S),
            clearance=with_gaps(Track(t, ground.clearances[known, index : index + 1]), STATE_GAP_S),
            age=with_gaps(_track(ages, 2, begin), STATUS_GAP_S),
            hold_s=hold_s,
            stop_s=stop_s,
            modes=spans_of(modes, begin, end_s, STATUS_GAP_S),
            lost=spans_of(lost, begin, end_s, STATE_GAP_S),
            waited_for=spans_of(waited, begin, end_s, STATE_GAP_S),
            compensation=with_gaps(_track(self._adapted(name), 6, begin), STATUS_GAP_S),
        )

    def _adapted(self, name: str) -> Sequence[tuple[Time, tuple[float, ...]]]:
        """The robot's adapted parameters, by whoever adapts them."""
        own = [(m.stamp_ns, m.compensation) for m in self._statuses[name] if len(m.compensation) == 6]
        central = [
            (m.stamp_ns, report.compensation)
            for m in self._states
            for report in m.roster
            if report.id == name and len(report.compensation) == 6
        ]
        return own or central

    def _snapshots(
        self,
        robots: Sequence[RobotSeries],
        true: Iterable[Stretch],
        running: Sequence[FormationState],
        begin: Time,
    ) -> tuple[Snapshot, ...]:
        """Start, most deformed while the task runs, end."""
        known = [robot.poses.t for robot in robots if len(robot.poses.t)]
        if not known:
            return ()
        moments = {"start": min(t[0] for t in known), "end": max(t[-1] for t in known)}
        since = running[0].stamp_ns if running else np.iinfo(np.int64).max
        if worst := _most_deformed([part for part in true if part.stamps[-1] >= since], since):
            moments = {"start": moments["start"], "most deformed": to_seconds(worst - begin)} | moments
        order = sorted(moments.items(), key=lambda item: item[1])
        return tuple(self._snapshot(name, t, robots, begin) for name, t in order)

    def _snapshot(self, name: str, t: float, robots: Sequence[RobotSeries], begin: Time) -> Snapshot:
        poses = np.array([_nearest(robot.poses, t) for robot in robots])
        chained = [m for m in self._states if m.chain]
        before = [m for m in chained if to_seconds(m.stamp_ns - begin) <= t]
        chain = (before[-1:] or chained[:1])[0].chain if chained else self._ids
        places = [self._ids.index(one) for one in chain if one in self._ids]
        triangles = tuple(zip(places, places[1:], places[2:], strict=False))
        return Snapshot(name, t, poses, control_points(poses, self._scenario), triangles)


def _triangles(
    states: Sequence[FormationState], true: Iterable[Stretch], begin: Time
) -> tuple[Triangle, ...]:
    """Every triangle that there ever was, in the order they came up."""
    seen: defaultdict[tuple[str, ...], Samples] = defaultdict(lambda: Samples(6))
    real: defaultdict[tuple[str, ...], list[tuple[Floats, Floats]]] = defaultdict(list)
    for state in states:
        for robots, errors in zip(_triples(state.chain), unpack_floats(state.errors, 6), strict=False):
            seen[robots].add(state.stamp_ns, tuple(errors.tolist()))
    for part in true:
        for place, robots in enumerate(_triples(part.chain)):
            known = np.isfinite(part.errors[:, place, 0])
            if known.any():
                real[robots].append((seconds(part.stamps[known], begin), part.errors[known, place]))
    found = []
    for robots in dict.fromkeys((*seen, *real)):
        stamps, errors = seen[robots].arrays()
        parts = real[robots] or [(np.empty(0), np.empty((0, 6)))]
        truth = Track(np.concatenate([t for t, _ in parts]), np.concatenate([rows for _, rows in parts]))
        estimate = Track(seconds(stamps, begin), errors)
        found.append(Triangle(robots, with_gaps(estimate, STATE_GAP_S), with_gaps(truth, STATE_GAP_S)))
    return tuple(found)


def _triples(chain: Sequence[str]) -> list[tuple[str, ...]]:
    return list(zip(chain, chain[1:], chain[2:], strict=False))


def _most_deformed(true: Sequence[Stretch], since: Time) -> Time | None:
    """When a side of a triangle, or beta across its mean side, is farthest off, from `since` on; where robots
    start scattered, from when that has fallen by half."""
    stamps = np.concatenate([part.stamps for part in true] or [np.empty(0, dtype=np.int64)])
    off = np.concatenate([_deformation(part) for part in true] or [np.empty(0)])
    off, stamps = off[stamps >= since], stamps[stamps >= since]
    if not len(off):
        return None
    formed = int((off <= 0.5 * off[0]).argmax())
    return int(stamps[formed:][off[formed:].argmax()])


def _deformation(part: Stretch) -> Floats:
    """How far the worst triangle is from its shape, m, at every moment of a stretch."""
    sides = np.abs(part.errors[..., 3:5]).max(axis=-1)
    across = np.abs(part.errors[..., 5]) * part.desired[..., 3:5].mean(axis=-1)
    return np.asarray(np.fmax.reduce(np.maximum(sides, across), axis=1))


def _path(states: Sequence[FormationState], scenario: Scenario) -> Floats:
    """The way of the reference in the world, a row of NaN where it jumps."""
    rows: list[tuple[float, float]] = []
    for (frame, _, _), group in groupby(states, lambda m: (m.frame, m.leg, m.goal)):
        origin = origin_of(frame, scenario)
        for m in group:
            x, y = origin.rotate(m.reference[0], m.reference[1])
            rows.append((origin.x + x, origin.y + y))
        rows.append((np.nan, np.nan))
    return np.array(rows[:-1]).reshape(-1, 2)


def _contacts(truths: Sequence[Truth], begin: Time) -> tuple[tuple[float, str], ...]:
    """When each contact began."""
    found, before = [], frozenset[str]()
    for truth in truths:
        now = frozenset(truth.contacts)
        found += [(to_seconds(truth.stamp_ns - begin), who) for who in sorted(now - before)]
        before = now
    return tuple(found)


def _track(rows: Iterable[tuple[Time, tuple[float, ...]]], columns: int, begin: Time) -> Track:
    samples = Samples(columns)
    for stamp, values in rows:
        samples.add(stamp, values)
    stamps, values_at = samples.arrays()
    return Track(seconds(stamps, begin), values_at)


def _nearest(track: Track, t: float) -> Floats:
    """The row whose time is next to `t`; NaN of an empty track."""
    known = np.flatnonzero(np.isfinite(track.values[:, 0]))
    if not len(known):
        return np.full(track.values.shape[1], np.nan)
    return np.asarray(track.values[known[np.abs(track.t[known] - t).argmin()]])


def _is_lost(state: FormationState, name: str) -> bool:
    return any(robot.id == name and robot.state == "lost" for robot in state.roster)


def outcome(series: Series) -> str:
    """How the run ended, in a sentence."""
    figures, last = series.figures, series.last_state
    hits = figures.collisions
    clean = f"with {hits} collision{'s' * (hits > 1)}" if hits else "without a collision"
    if hits is None:
        clean = "with no ground truth to tell collisions"
    elif figures.without_truth:
        clean += f" as far as ground truth tells (none of {', '.join(figures.without_truth)})"
    if last is None:
        return "The recording holds no word of the controller."
    if figures.completed:
        unknown = figures.final_error.position_m is None
        end = figures.estimated_final_error if unknown else figures.final_error
        off = end.out_of_formation_m
        but = f", but out of formation: {off:.1f} m off at the end" if off else ""
        return f"Completed in {figures.duration_s:.1f} s, {clean}{but}."
    why = f": {last.reason}" if last.reason else ""
    waits = f", waiting for {', '.join(last.waits_for)}" if last.waits_for and not last.reason else ""
    covered = f"{100 * series.task_share:.0f} % of the task's time"
    return f"Not completed: it ended {last.phase}{why}{waits}, after {covered}, {clean}."
