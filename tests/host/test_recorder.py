"""The recorder: what it writes down, what it keeps out, and what it holds for a router that comes back."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event, Thread

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.messages import Call, EmergencyStop, FaultPlan, Journal, Message, Odometry
from maniple.core.scenario.parse import digest_of, to_json
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.fate import Death, Pause
from maniple.host.inbox import BACKLOG
from maniple.host.recorder import MOST_STRANGE, RecorderHost, keys_of, late_text
from maniple.host.router import RouterHost
from maniple.recording.reader import read
from maniple.recording.split import PartsWriter
from maniple.recording.tally import Tally
from maniple.recording.writer import RecordingWriter
from maniple.transport.zenoh import MAX_BYTES, ZenohSession, crc_of
from tests.host.nodes import odometry, scenario_with
from tests.host.test_latched import message, stop
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

TOPIC = "robot/r1/odometry"
MET: list[Death | Pause] = []


@contextmanager
def recorder(
    endpoint: str,
    path: Path,
    clock: Anchor | None = None,
    takes: Callable[[str], bool] = lambda _: True,
    writer: type[RecordingWriter] = RecordingWriter,
) -> Iterator[RecorderHost]:
    """A recorder in a thread of its own; the recording is whole at the end."""
    scenario = scenario_with()
    parts = PartsWriter(lambda _: writer(path, to_json(scenario), {}, prefix="test"))
    with closing(parts), ZenohSession.client(endpoint, "test") as session:
        host = RecorderHost(
            parts,
            clock or Anchor.here(),
            [session],
            scenario,
            lambda event, _: MET.append(event),
            takes=takes,
        )
        thread = Thread(target=host.run)
        thread.start()
        try:
            with ZenohSession.client(endpoint, "test") as other:
                eventually(lambda: other.lives("recorder"))
            yield host
        finally:
            host.stop()
            thread.join(DEADLINE_S)


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "test") as session:
        RouterHost(session, Anchor.here(), grace_s=0.0).start()
        yield address


def recorded(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for entry in read(path).messages():
        found.setdefault(entry.topic, []).append(entry.data)
    return found


def test_garbage_of_any_kind_on_any_key_is_written_down_or_counted(
    endpoint: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    names = [row.pattern.replace("{id}", "r1") for row in topics.TOPICS if row.network != "host"]
    forged = codec.encode(
        msgspec.structs.replace(odometry("r1"), incarnation=2**61, seq=2**61, stamp_ns=2**61)
    )
    payloads = [b"", b"\xc1", bytes(100), forged]
    with recorder(endpoint, path) as host, ZenohSession.client(endpoint, "test") as foe:
        while not host.unwritten["huge"]:  # a busy network drops what is huge by itself
            foe.put_raw("robot/r1/command", bytes(MAX_BYTES + 1))
            foe.settle()
        for name in names:
            for data in payloads:
                foe.put_raw(name, data)
        foe.put_raw("robot/r1/command", b"flipped", crc_of(b"whole"))
        foe.put_raw("k" * 1000, b"a key without end")
        for number in range(MOST_STRANGE + 10):
            foe.put_raw(f"made/up/{number}", b"x")
        eventually(lambda: host.unwritten["unknown key"] == 11)
        foe.put(TOPIC, message(7))  # has priority: from here on its topic is sealed
        foe.settle()
    said = recorded(path)
    assert all(said[name][: len(payloads)] == payloads for name in names)
    assert said[TOPIC][-1] == message(7)
    assert sum(name.startswith("made/up/") for name in said) == MOST_STRANGE
    huge = host.unwritten["huge"]
    assert dict(host.unwritten) == {"unknown key": 11, "huge": huge, "corrupted": 1}
    assert f"not recorded: 1 corrupted, {huge} huge, 11 unknown key" in capfd.readouterr().err


def test_the_keys_of_a_scenario_always_have_room() -> None:
    keys = keys_of(scenario_with())
    assert {
        "robot/r1/odometry",
        "journal/controller",
        "journal/simulator",
        "faults/plan",
        "hw/r1/scan",
    } <= keys
    assert not any(name.startswith("host/") for name in keys)


def test_it_goes_on_when_the_router_is_back_and_tells_it_what_was_latched(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    path = tmp_path / "a.mcap"
    first = ZenohSession.router(address, "test")
    RouterHost(first, Anchor.here(), grace_s=0.0).start()
    with recorder(address, path), ZenohSession.client(address, "test") as node:
        node.announce("r1", 3)
        node.put(topics.STOP, stop(5))
        node.put(TOPIC, message(4, incarnation=3))
        node.put(topics.FORMATION_GOAL, b"garbage that is not held")
        node.settle()
        first.close()
        with ZenohSession.router(address, "test") as second:
            RouterHost(second, Anchor.here(), grace_s=0.0).start()
            assert eventually(lambda: node.ask(topics.STOP)) == {topics.STOP: stop(5)}
            assert eventually(lambda: node.ask(TOPIC)) == {TOPIC: message(4, incarnation=3)}
            assert node.ask(topics.FORMATION_GOAL) == {}
            node.put(TOPIC, message(6, incarnation=3))
            node.settle()
            with ZenohSession.client(address, "test") as other:
                eventually(lambda: other.ask(TOPIC) == {TOPIC: message(6, incarnation=3)})
    said = recorded(path)
    assert [codec.decode(TOPIC, data).seq for data in said[TOPIC]] == [4, 6]
    assert said[topics.STOP][0] == stop(5)


def test_it_dies_and_freezes_as_the_plan_says(endpoint: str, tmp_path: Path) -> None:
    clock = Anchor.here(5.0)
    MET.clear()
    with recorder(endpoint, tmp_path / "a.mcap", clock), ZenohSession.client(endpoint, "test") as operator:
        plan = msgspec.convert(
            {
                "incarnation": 1,
                "since_ns": clock.now(),
                "freezes": [{"node": "recorder", "at_s": 1.0, "for_s": 0.5}],
                "crashes": [{"node": "recorder", "at_s": 2.0}],
            },
            FaultPlan,
        )
        operator.put(topics.PLAN, codec.encode(plan))
        eventually(lambda: len(MET) >= 2)
    assert isinstance(MET[0], Pause)
    assert isinstance(MET[1], Death)


def test_who_records_late_has_the_orders_that_hold(endpoint: str, tmp_path: Path) -> None:
    """For a router that comes back; they are not written down a second time."""
    path = tmp_path / "a.mcap"
    with ZenohSession.client(endpoint, "test") as operator:
        operator.put(topics.STOP, stop(5))
        operator.settle()
        with recorder(endpoint, path) as host:
            held = host._store.message(topics.STOP)
    assert isinstance(held, EmergencyStop)
    assert topics.STOP not in recorded(path)


def test_log_time_is_when_it_arrived_by_the_clock_of_the_run(endpoint: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    clock = Anchor(7 * SECOND, Anchor.here().monotonic_ns, 1.0)
    with recorder(endpoint, path, clock), ZenohSession.client(endpoint, "test") as node:
        before = clock.now()
        node.put(TOPIC, message(0))
        node.settle()
        after = clock.now()
    (entry,) = (entry for entry in read(path).messages() if entry.topic == TOPIC)
    assert isinstance(entry.message, Message)
    assert isinstance(entry.message, Odometry)
    assert before <= entry.log_time_ns <= after + SECOND


def test_what_is_left_out_is_held_all_the_same(endpoint: str, tmp_path: Path) -> None:
    """For a router that comes back."""
    path = tmp_path / "a.mcap"
    with (
        recorder(endpoint, path, takes=lambda topic: topic == TOPIC) as host,
        ZenohSession.client(endpoint, "test") as node,
    ):
        node.put(topics.STOP, stop(5))
        node.put(TOPIC, message(0))
        node.settle()
        eventually(lambda: host._store.message(topics.STOP))
    assert recorded(path) == {TOPIC: [message(0)]}


def test_who_runs_another_scenario_is_told_of_once(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, own = tmp_path / "a.mcap", digest_of(to_json(scenario_with()))
    said = [
        (source, seq, Call("start", 5, digest))
        for source, seq, digest in (
            ("r1", 0, own),
            ("r2", 0, "f" * 64),
            ("r2", 0, "f" * 64),
            ("r3", 0, ""),
            ("controller", 3, "e" * 64),
        )
    ]
    with recorder(endpoint, path), ZenohSession.client(endpoint, "test") as node:
        for source, seq, call in said:
            journal = Journal(source=source, incarnation=2, seq=seq, stamp_ns=seq, calls=(call,))
            node.put(topics.journal(source), codec.encode(journal))
        node.settle()
    told = [line for line in capsys.readouterr().err.splitlines() if "another scenario" in line]
    assert len(told) == 1
    assert f"r2 (life 2) runs another scenario ({'f' * 16}) than the recorder's ({own[:16]})" in told[0]
    (metadata,) = read(path).all_metadata
    assert metadata["maniple.other_scenarios"] == {"r2 (life 2)": "f" * 64}


def test_what_came_before_is_told_by_its_sender() -> None:
    tally = Tally()
    assert late_text(tally.streams()) == ""
    tally.note(TOPIC, "r1", 1, 0)
    tally.note(TOPIC, "r2", 1, 5)
    tally.note("robot/r2/status", "r2", 1, 1)
    tally.note("robot/r2/status", "r2", 1, 4)
    tally.note(TOPIC, "controller", 2, 3)
    assert late_text(tally.streams()) == (
        "came late: the first 9 messages are missing (3 of controller, 6 of r2)"
    )


def test_a_disk_that_stands_still_holds_up_nobody(endpoint: str, tmp_path: Path) -> None:
    """What arrives meanwhile waits in memory, and has the time at which it arrived."""
    begun, stands, goes = Event(), Event(), Event()

    class Disk(RecordingWriter):
        def flush(self) -> None:
            if begun.is_set():
                stands.set()
                assert goes.wait(DEADLINE_S)
            super().flush()

    path, heard = tmp_path / "a.mcap", list[bytes]()
    with (
        recorder(endpoint, path, writer=Disk),
        ZenohSession.client(endpoint, "test") as node,
        ZenohSession.client(endpoint, "test") as other,
    ):
        other.subscribe(TOPIC, lambda _, data: heard.append(data))
        other.settle()
        node.put(TOPIC, message(0))
        begun.set()
        assert stands.wait(DEADLINE_S)
        for seq in range(1, 2000):
            node.put(TOPIC, message(seq))
            if seq % 200 == 0:
                node.settle()  # faster, a busy network may drop some
        eventually(lambda: len(heard) == 2000)
        eventually(lambda: [*other.ask(f"{BACKLOG}/*").values()] == [b"2046976"])  # 1999, each at least 1 KiB
        opened_ns = time.time_ns()
        goes.set()
    entries = [entry for entry in read(path).messages() if entry.topic == TOPIC]
    assert [entry.sequence for entry in entries] == list(range(2000))
    assert all(entry.log_time_ns < opened_ns for entry in entries)


def test_it_tells_who_plays_how_much_waits_in_it(endpoint: str, tmp_path: Path) -> None:
    with recorder(endpoint, tmp_path / "a.mcap"), ZenohSession.client(endpoint, "test") as player:
        answers = eventually(lambda: player.ask(f"{BACKLOG}/*"))
        assert len(answers) == 1
        player.put(TOPIC, message(0))
        player.settle()
        eventually(lambda: set(player.ask(f"{BACKLOG}/*").values()) == {b"0"})
