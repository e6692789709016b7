"""What is measured of platoons whose processes die and freeze."""

import math
from pathlib import Path
from typing import Any

import pytest

from benchmarks.reliability.__main__ import BEGIN, DOC, END, table, with_part
from benchmarks.reliability.analysis import Analysis, Found, between
from benchmarks.reliability.runs import SCENE, Case, Done, Event, run
from maniple.cli.loading import loads
from maniple.core import codec, topics
from maniple.core.messages import (
    Call,
    Command,
    Drive,
    FormationState,
    Journal,
    Message,
    Odometry,
    Stamp,
    Truth,
    pack_floats,
)
from maniple.core.scenario.parse import to_json
from maniple.core.time import SECOND, Time, from_seconds
from maniple.recording.writer import RecordingWriter

ROBOTS = ("r1", "r2", "r3", "r4", "r5", "r6")


class Tape:
    """A recording that is made up, message by message."""

    def __init__(self, folder: Path) -> None:
        self.scenario = loads(SCENE.encode())
        self._path = folder / "a.mcap"
        self._said: list[tuple[Time, str, Message]] = []
        self._seqs: dict[tuple[str, str, int], int] = {}

    def say(self, at_s: float, topic: str, kind: type[Any], source: str, life: int = 1, **fields: Any) -> int:
        """Record a message of that time; returns its number."""
        key = (topic, source, life)
        seq = self._seqs[key] = self._seqs.get(key, -1) + 1
        stamp = at(at_s)
        head = {"source": source, "incarnation": life, "seq": seq, "stamp_ns": stamp}
        self._said.append((stamp, topic, kind(**head, **fields)))
        return seq

    def truth(self, at_s: float, speeds: dict[str, float], x_m: float = 0.0, collisions: int = 0) -> None:
        velocities = [(speeds.get(name, 0.0), 0.0) for name in ROBOTS]
        self.say(
            at_s,
            topics.TRUTH,
            Truth,
            "simulator",
            robots=ROBOTS,
            poses=pack_floats([(x_m, 0, 0)] * 6),
            velocities=pack_floats(velocities),
            clearances=pack_floats([1.0] * 6),
            collisions=collisions,
        )

    def state(self, at_s: float, rate: float, life: int = 1, waits_for: tuple[str, ...] = ()) -> None:
        self.say(
            at_s,
            topics.FORMATION_STATE,
            FormationState,
            "controller",
            life,
            phase="running",
            task_time_s=at_s,
            task_duration_s=100.0,
            reference=(0.0, 0.0, 0.0),
            reference_velocity=(0.0, 0.0, 0.0),
            chain=ROBOTS,
            errors=b"",
            roster=(),
            rate=rate,
            waits_for=waits_for,
        )

    def found(self, *events: Event) -> list[Found]:
        self._path.unlink(missing_ok=True)
        with RecordingWriter(
            self._path, to_json(self.scenario), {"maniple": "x"}, prefix="maniple", now=at(0)
        ) as writer:
            for stamp, topic, message in sorted(self._said, key=lambda said: said[0]):
                writer.write(topic, codec.encode(message), stamp, stamp, message.seq)
        return Analysis(Done(self.scenario, [self._path], list(events))).found(events)


def at(seconds: float) -> Time:
    return 1000 * SECOND + from_seconds(seconds)


def test_the_death_of_a_controller(tmp_path: Path) -> None:
    """Killed at 5 s: all stand at 6.4 s, it is back at 7 s, and all follow from 7.6 s on."""
    tape = Tape(tmp_path)
    for tick in range(100):
        now = tick / 10
        tape.truth(now, dict.fromkeys(ROBOTS, 0.0 if 6.35 < now < 7.5 else 0.2))
        if now < 4.95 or now > 6.95:
            life = 1 if now < 6 else 2
            tape.state(now, 0.0 if 6.95 < now < 7.45 else 1.0, life, ("r1",) if 6.95 < now < 7.55 else ())
    (found,) = tape.found(Event(Case("kill", "controller"), at(5.0), None))
    assert found.stood_s == pytest.approx(1.4)
    assert found.back_s == pytest.approx(2.0)
    assert found.reference_s == pytest.approx(2.0)
    assert found.recovered_s == pytest.approx(0.6)
    brake = tape.scenario.model_of(tape.scenario.robots[0]).brake_mps2
    assert found.bound_s == pytest.approx(1.0 + 0.2 / brake + 0.5)
    assert (found.held, found.collisions, found.ok) == (True, 0, True)


def test_a_robot_that_does_not_stand_in_time(tmp_path: Path) -> None:
    tape = Tape(tmp_path)
    for tick in range(100):
        now = tick / 10
        tape.truth(now, dict.fromkeys(ROBOTS, 0.2) | {"r4": 0.02}, collisions=int(now > 6))
        tape.state(now, 1.0)
    frozen = Event(Case("freeze", "controller"), at(5.0), at(8.0))
    (found,) = tape.found(frozen)
    assert (found.stood_s, found.held, found.collisions, found.ok) == (None, False, 1, False)
    (found,) = tape.found(frozen._replace(case=Case("freeze", "recorder")))
    assert (found.held, found.bound_s) == (True, 0.0)


def test_without_a_router_the_way_tells_how_long_they_rolled(tmp_path: Path) -> None:
    """0.15 m at 0.2 m/s; nothing is heard from 5 s to 6.5 s."""
    tape = Tape(tmp_path)
    for tick in range(100):
        now = tick / 10
        if now < 5.05 or now > 6.45:
            tape.truth(now, dict.fromkeys(ROBOTS, 0.2), 0.0 if now < 6 else 0.15)
            tape.state(now, 1.0)
    (found,) = tape.found(Event(Case("kill", "router"), at(5.0), None))
    assert found.stood_s == pytest.approx(0.75)
    assert found.back_s == pytest.approx(1.5)
    assert found.recovered_s == pytest.approx(0.1)


def test_a_robot_is_back_with_the_first_word_of_its_next_life(tmp_path: Path) -> None:
    tape = Tape(tmp_path)
    for tick in range(100):
        now = tick / 10
        tape.truth(now, dict.fromkeys(ROBOTS, 0.2) | ({"r3": 0.0} if now > 5.55 else {}))
        tape.state(now, 1.0)
        if now < 5.05 or now > 6.85:
            pose: dict[str, Any] = {"x_m": 0.0, "y_m": 0.0, "psi_rad": 0.0, "u_mps": 0.0, "w_radps": 0.0}
            tape.say(now, "robot/r3/odometry", Odometry, "r3", 1 if now < 6 else 2, frame_id="r3", **pose)
    (found,) = tape.found(Event(Case("kill", "r3"), at(5.05), None))
    assert found.back_s == pytest.approx(1.85)
    assert found.stood_s == pytest.approx(0.55)
    assert found.reference_s is None


def test_the_oldest_command_of_a_moving_robot(tmp_path: Path) -> None:
    """A command that answers what was said at 4.9 s is taken in at 5 s, and moves the robot up to 5.8 s; what
    is told later is zero, or not covered by its journal."""
    tape = Tape(tmp_path)
    for tick in range(100):
        tape.truth(tick / 10, {})
        tape.state(tick / 10, 1.0)
    command: dict[str, Any] = {"layer": "drive", "values": (0.2, 0.0), "inputs_age_ns": 0}
    seq = tape.say(4.95, "robot/r1/command", Command, "controller", answers=Stamp(1, 0, at(4.9)), **command)
    call = Call("message", at(5.0), "robot/r1/command", "controller", 1, seq)
    tape.say(5.1, "journal/r1", Journal, "r1", calls=(call,))
    tape.say(6.1, "journal/r1", Journal, "r1", calls=())
    for now, speed in ((5.5, 0.2), (5.8, 0.1), (6.0, 0.0), (6.5, 0.2)):
        tape.say(now, "hw/r1/drive", Drive, "r1", u_mps=speed, w_radps=0.0, active=True)
    (found,) = tape.found(Event(Case("freeze", "controller"), at(5.0), at(8.0)))
    assert found.age_s == pytest.approx(0.9)


def test_between() -> None:
    said = [Message(stamp_ns=at) for at in (1, 2, 3, 4)]
    assert [message.stamp_ns for message in between(said, 1, 3)] == [2, 3]


FOUND = Found(Case("kill", "r3"), 0.9, 1.9, True, 0.5, 1.2, 0.6, 0.16, 0)


def test_the_table_has_the_worst_of_each_case() -> None:
    worse = FOUND._replace(stood_s=1.1, held=False, recovered_s=math.inf, collisions=1)
    free = Found(Case("freeze", "recorder"), None, 0.0, True, None, 3.0, 0.05, 0.1, 0)
    rows = table([FOUND, free, worse]).splitlines()
    assert rows[2] == "| kill r3 | 1.10 | 1.90 | 0.50 | 1.20 | inf | 0.16 | 1 | NO |"
    assert rows[3] == "| freeze recorder | go on |  | goes on | 3.00 | 0.05 | 0.10 | 0 | yes |"
    assert len(rows) == 4


def test_the_document_has_a_place_for_it() -> None:
    text = with_part(DOC.read_text(), "new\n")
    assert f"{BEGIN}new\n{END}" in text
    with pytest.raises(ValueError, match="no marks"):
        with_part("nothing", "new")


@pytest.mark.slow
def test_the_promises_hold(tmp_path: Path) -> None:
    """A smaller set of the cases. A busy machine starts processes late, but must not stop robots late."""
    kills = [Case("kill", who) for who in ("r3", "controller", "router")]
    freezes = [Case("freeze", who) for who in ("controller", "simulator")]
    done = run([*kills, *freezes], tmp_path)
    for found in Analysis(done).found(done.events):
        assert found.ok, found
