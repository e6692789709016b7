"""Recordings over real Zenoh sessions: what those hear who listen, and what is refused."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.errors import ArgumentError, RecordingError, RunError, TransportError
from maniple.core.messages import EmergencyStop
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.host.clock import Anchor
from maniple.host.joining import claim, clock_of
from maniple.host.player import How, Player, Playing
from maniple.host.router import RouterHost
from maniple.recording.cut import cut
from maniple.recording.reader import Recorded, read
from maniple.recording.selection import Selection
from maniple.transport.zenoh import ZenohSession
from tests.host.nodes import command, odometry
from tests.recording.traffic import drive, record
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

PREFIX = "maniple"
FAST = How(rate=None)
ALL = Selection()


def said(number: int, source: str, topic: str, message: Any, step: int = 50 * MILLISECOND) -> Recorded:
    now = VIRTUAL_EPOCH + number * step
    stamped = msgspec.structs.replace(message, source=source, incarnation=2, seq=number, stamp_ns=now)
    return Recorded(topic, codec.encode(stamped), now, now, number)


def platoon(ticks: int = 40, step: int = 50 * MILLISECOND) -> list[Recorded]:
    """Topics of all priorities, four messages at each moment, 2 s of them."""
    stop = Recorded(
        topics.STOP,
        codec.encode(EmergencyStop(source="operator", incarnation=7, stopped=True)),
        VIRTUAL_EPOCH,
        0,
        0,
    )
    found = [stop]
    for tick in range(ticks):
        now = VIRTUAL_EPOCH + tick * step
        found += [
            said(tick, "r1", topics.odometry("r1"), odometry("r1/1", x_m=float(tick)), step),
            said(tick, "controller", topics.command("r1"), command(), step),
            Recorded("made/by/users", b"%d" % tick, now, now, 0),
            Recorded("hw/r1/drive", drive(tick, incarnation=2), now, now, tick),
        ]
    return found


class Ear:
    """Listens to everything."""

    def __init__(self, endpoint: str, prefix: str = PREFIX, delay_s: float = 0.0) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.lives: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
        self._delay_s = delay_s
        self.session = ZenohSession.client(endpoint, prefix)
        self.session.subscribe("**", self._hear)
        self.session.watch(lambda *life: self.lives.put(life))
        self.session.settle()

    def _hear(self, topic: str, data: bytes) -> None:
        if self._delay_s:
            time.sleep(self._delay_s)
        self.heard.append((topic, data))

    def has(self, count: int) -> bool:
        """Whether it has heard so many messages."""
        return len(self.heard) == count

    def everybody(self) -> list[tuple[str, int, bool]]:
        """Who came and went so far."""
        return [self.lives.get_nowait() for _ in range(self.lives.qsize())]


@contextmanager
def ear(endpoint: str, prefix: str = PREFIX, delay_s: float = 0.0) -> Iterator[Ear]:
    one = Ear(endpoint, prefix, delay_s)
    try:
        yield one
    finally:
        one.session.close()


@contextmanager
def playing(
    path: Path, how: How = FAST, selection: Selection = ALL, endpoint: str = "", prefix: str = PREFIX
) -> Iterator[tuple[Player, str]]:
    """A player that has not started, on a router of its own unless an endpoint is given."""
    address = endpoint or f"tcp/127.0.0.1:{free_port()}"
    opened = ZenohSession.client if endpoint else ZenohSession.router
    with opened(address, prefix, patience_s=60.0) as session:
        player = Player(read(path), selection, session, not endpoint, how)
        try:
            yield player, address
        finally:
            player.stop()
            if player._thread.is_alive():
                player._thread.join(DEADLINE_S)


def ended(player: Player) -> Playing:
    """Once it has played to its end."""
    eventually(lambda: player.wait(0.01))
    return player.state()


def everyone(endpoint: str) -> dict[str, tuple[int, ...]]:
    """Who is there. A session that watches would know only in part."""
    with ZenohSession.client(endpoint, PREFIX) as session:
        return session.everyone()


def pairs(messages: Sequence[Recorded]) -> list[tuple[str, bytes]]:
    return [(message.topic, message.data) for message in messages]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return record(tmp_path / "a.mcap", platoon())


@pytest.fixture
def router() -> Iterator[str]:
    """A router of a platoon."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, PREFIX) as session:
        RouterHost(session, Anchor.here(), grace_s=0.0).start()
        yield address


def test_everything_is_heard_in_the_order_of_the_file_whatever_its_topic(file: Path) -> None:
    with playing(file) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        found = ended(player)
        eventually(lambda: len(listener.heard) >= 161)
    assert listener.heard == pairs(platoon())
    assert (found.messages, found.loops, found.bytes) == (161, 1, sum(len(m.data) for m in platoon()))
    assert found.recorded_s == found.position_s == found.end_s == pytest.approx(1.95)
    assert found.reached_rate > 1.0


def test_lives_are_shown_while_they_last(file: Path) -> None:
    with playing(file) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        eventually(lambda: player.wait(0.01))
        eventually(lambda: listener.lives.qsize() >= 5)
        seen = listener.everybody()
        assert everyone(endpoint) == {"router": (1,)}
    assert seen[0] == ("router", 1, True)
    assert {life for life in seen if life[0] == "r1"} == {("r1", 2, True), ("r1", 2, False)}
    assert {life[0] for life in seen} == {"router", "r1", "controller"}


def test_it_takes_as_long_as_the_recording_at_the_rate(file: Path) -> None:
    with playing(file, How(rate=10.0)) as (player, endpoint), ear(endpoint) as listener:
        begin = time.monotonic()
        player.start()
        found = ended(player)
        took = time.monotonic() - begin
        eventually(lambda: len(listener.heard) >= 161)
    assert took >= 0.19
    assert found.reached_rate <= 10.1
    assert listener.heard == pairs(platoon())


def test_a_late_joiner_gets_what_is_latched_and_the_time_of_the_recording(file: Path) -> None:
    with playing(file, How(paused=True)) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        assert listener.session.ask(topics.STOP) == {}
        player.step(82)
        eventually(lambda: len(listener.heard) == 82)
        kept = listener.session.ask(topics.odometry("r1"))
        assert kept == {topics.odometry("r1"): platoon()[81].data}
        assert listener.session.ask(topics.STOP) == {topics.STOP: platoon()[0].data}
        clock = clock_of(listener.session)
        assert abs(clock.now() - platoon()[81].log_time_ns) < 5 * SECOND
        assert clock.speed == 1.0
        assert everyone(endpoint) == {"router": (1,), "r1": (2,), "controller": (2,)}


def test_it_is_told_from_outside_to_step_to_pause_and_to_go_on(file: Path) -> None:
    def tell(order: str) -> Playing:
        return msgspec.json.decode(listener.session.ask(order)[order], type=Playing)

    with playing(file, How(rate=None, paused=True)) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        assert tell("play/status").paused
        for order, count in (("play/step", 1), ("play/step/10", 11)):
            tell(order)
            assert eventually(lambda: player.state().messages) >= 1
            eventually(partial(listener.has, count))
        assert tell("play/status").messages == 11
        for nothing in ("play/garbage", "play/step/-1", "play/step/x", "play/pause/2", "play/step/1/2"):
            assert listener.session.ask(nothing) == {}
        tell("play/resume")
        ended(player)
        eventually(lambda: len(listener.heard) == 161)
        assert tell("play/pause").loops == 1


def test_again_and_again(file: Path) -> None:
    with playing(file, How(rate=None, times=3)) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        found = ended(player)
        eventually(lambda: len(listener.heard) == 3 * 161)
    assert listener.heard == 3 * pairs(platoon())
    assert found.loops == 3
    assert found.recorded_s == pytest.approx(3 * 1.95)


def test_until_it_is_stopped(file: Path) -> None:
    with playing(file, How(rate=None, times=None)) as (player, endpoint), ear(endpoint):
        player.start()
        eventually(lambda: player.state().loops >= 2)
        player.stop()
        ended(player)
        eventually(lambda: everyone(endpoint) == {"router": (1,)})


def test_from_the_middle_what_is_latched_comes_first(file: Path) -> None:
    start = VIRTUAL_EPOCH + SECOND
    selection = Selection(start, start + SECOND // 2, without=("made/**",))
    with playing(file, FAST, selection) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        found = ended(player)
        eventually(lambda: len(listener.heard) == 32)
    sent = platoon()
    played = [message for message in sent if selection.holds(message.log_time_ns)]
    before = [sent[0], sent[1 + 19 * 4]]
    assert listener.heard == pairs([*before, *(m for m in played if m.topic != "made/by/users")])
    assert found.position_s == pytest.approx(1.45)


def test_a_recording_that_begins_in_the_middle_has_what_is_latched_attached(
    file: Path, tmp_path: Path
) -> None:
    """Cut out of another, or written by a recorder that came late."""
    start = VIRTUAL_EPOCH + SECOND
    half = tmp_path / "cut.mcap"
    cut(read(file), Selection(start, start + SECOND // 2, without=("made/**",)), half)
    with playing(half, FAST) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        ended(player)
        eventually(lambda: len(listener.heard) == 32)
    sent = platoon()
    assert listener.heard[:2] == pairs([sent[0], sent[1 + 19 * 4]])


def test_the_last_value_is_known_before_it_goes_on(file: Path) -> None:
    selection = Selection(VIRTUAL_EPOCH + SECOND)
    with playing(file, How(paused=True), selection) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        name = topics.odometry("r1")
        assert eventually(lambda: listener.session.ask(name)) == {name: platoon()[77].data}
        assert player.state().position_s == 1.0
        assert listener.heard == []


def test_under_another_prefix(file: Path) -> None:
    with playing(file, prefix="other") as (player, endpoint), ear(endpoint, "other") as listener:
        with ear(endpoint) as stranger:
            player.start()
            ended(player)
            eventually(lambda: len(listener.heard) == 161)
        assert stranger.heard == []


def test_onto_the_router_of_others(file: Path, router: str) -> None:
    with playing(file, endpoint=router) as (player, _), ear(router) as listener:
        player.start()
        ended(player)
        eventually(lambda: len(listener.heard) == 161)
        assert eventually(lambda: listener.session.ask(topics.odometry("r1"))) == {
            topics.odometry("r1"): platoon()[-4].data
        }
    assert listener.heard == pairs(platoon())


def test_who_is_slow_slows_everything_and_misses_nothing(tmp_path: Path) -> None:
    sent = platoon(2_000, MILLISECOND)
    path = record(tmp_path / "a.mcap", sent)
    with playing(path) as (player, endpoint), ear(endpoint, delay_s=1e-4) as listener:
        player.start()
        ended(player)
        eventually(lambda: len(listener.heard) == len(sent))
    assert listener.heard == pairs(sent)


def test_it_waits_for_who_says_that_much_waits_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniple.host.player.LOOK_EVERY", 64 << 10)
    path = record(tmp_path / "a.mcap", platoon(400))
    waiting = [b"99999999"]
    asked = threading.Event()

    def backlog(name: str) -> dict[str, bytes]:
        asked.set()
        return {name: waiting[0]}

    with playing(path) as (player, endpoint), ear(endpoint) as listener:
        listener.session.serve("backlog/ear", backlog)
        listener.session.settle()
        player.start()
        assert asked.wait(DEADLINE_S)
        put = player.state().messages
        assert put < 100
        eventually(lambda: len(listener.heard) == put)
        assert player.state().messages == put
        waiting[0] = b"garbage that counts as nothing"
        ended(player)
        eventually(lambda: len(listener.heard) == 1601)


def test_no_node_that_lives_there_hears_anything(file: Path, router: str) -> None:
    with ear(router) as listener, ZenohSession.client(router, PREFIX) as robot:
        robot.announce("r1", 1)
        eventually(lambda: "r1" in everyone(router))
        with (
            pytest.raises(ArgumentError, match=r"^r1 live there: .*--prefix"),
            playing(file, endpoint=router),
        ):
            pass
        assert listener.heard == []
        with playing(file, endpoint=router, prefix="other") as (player, _):
            player.start()
            ended(player)
        assert listener.heard == []


@pytest.mark.parametrize(
    ("chosen", "left_out"),
    [
        ((), ["hw/r1/drive", "platoon/stop", "robot/r1/command", "robot/r1/odometry"]),
        (("robot/**",), ["hw/r1/drive", "platoon/stop", "made/by/users"]),
    ],
)
def test_orders_and_what_living_nodes_say_is_played_there_only_where_it_is_named(
    file: Path, router: str, chosen: tuple[str, ...], left_out: list[str]
) -> None:
    sent = [message for message in platoon() if message.topic not in left_out]
    with ear(router) as listener, ZenohSession.client(router, PREFIX) as robot:
        robot.announce("r1", 1)
        eventually(lambda: "r1" in everyone(router))
        listener.everybody()
        how = How(rate=None, onto_live_nodes=True)
        with playing(file, how, Selection(topics=chosen), router) as (player, _):
            assert list(player.left_out) == ([] if chosen else left_out)
            player.start()
            ended(player)
            eventually(lambda: len(listener.heard) == len(sent))
            eventually(lambda: ("controller", 2, False) in listener.everybody() or not chosen)
        assert "r1" in everyone(router)
        assert not [life for life in listener.everybody() if life[0] == "r1"]
    assert listener.heard == pairs(sent)


def test_it_ends_when_a_node_comes_to_life(file: Path, router: str) -> None:
    with playing(file, How(paused=True), endpoint=router) as (player, _):
        player.start()
        with ZenohSession.client(router, PREFIX) as robot:
            robot.announce("r9", 4)
            with pytest.raises(RunError, match=r"r9 \(incarnation 4\) came to life"):
                eventually(lambda: player.wait(0.01))
            player._thread.join(DEADLINE_S)


def test_a_recorder_may_come(file: Path) -> None:
    with playing(file, How(paused=True)) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        listener.session.announce("recorder", 1)
        eventually(lambda: "recorder" in everyone(endpoint))
        player.step()
        eventually(lambda: listener.heard)
        assert not player.wait(0.0)


def test_no_node_can_join_a_recording(file: Path) -> None:
    with playing(file, How(paused=True)) as (player, endpoint):
        player.start()
        player.step(2)
        with ZenohSession.client(endpoint, PREFIX) as robot:
            with pytest.raises(TransportError, match="r9 can't join: a recording is played there"):
                claim(robot, "r9")
            with pytest.raises(TransportError, match="can't join"):
                claim(robot, "r9", wanted=3)
            eventually(lambda: robot.lives("r1"))
            with pytest.raises(TransportError, match="r1 is running already"):
                claim(robot, "r1", patience_s=0.0)


def test_it_ends_when_the_router_goes(file: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    other = ZenohSession.router(address, PREFIX)
    with playing(file, How(paused=True), endpoint=address) as (player, _):
        player.start()
        assert not player.wait(0.0)
        other.close()
        with pytest.raises(RunError, match="the router went away"):
            eventually(lambda: player.wait(0.01))


@pytest.mark.parametrize(
    ("topic", "selection", "text"),
    [
        ("hw/r1/*", Selection(), r"topic 'hw/r1/\*' can't be a key"),
        ("@told/seen", Selection(), "can't be a key"),
        ("a//b", Selection(), "can't be a key"),
        ("hw/r1/drive", Selection(topics=("robot/**",)), "no message of the topics and the time asked for"),
        ("hw/r1/drive", Selection(end_ns=VIRTUAL_EPOCH - 1), "no message of the topics and the time"),
    ],
)
def test_what_can_not_be_played_is_said_first(
    tmp_path: Path, topic: str, selection: Selection, text: str
) -> None:
    message = Recorded(topic, drive(0), VIRTUAL_EPOCH, VIRTUAL_EPOCH, 0)
    path = record(tmp_path / "a.mcap", [message])
    with pytest.raises(RecordingError, match=text), playing(path, FAST, selection):
        pass


def test_a_message_that_is_due_in_a_thousand_years_is_waited_for(tmp_path: Path) -> None:
    times = (0, 2**63)
    path = record(tmp_path / "a.mcap", [Recorded("hw/r1/drive", drive(0), at, at, 0) for at in times])
    with playing(path, How(rate=0.01)) as (player, endpoint), ear(endpoint) as listener:
        player.start()
        eventually(lambda: listener.heard)
        assert not player.wait(0.1)
        player.stop()
        assert ended(player).messages == 1


def test_whatever_fails_is_no_end(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("whatever")

    with playing(file) as (player, _):
        monkeypatch.setattr(ZenohSession, "put_in_order", fail)
        player.start()
        with pytest.raises(ValueError, match="whatever"):
            eventually(lambda: player.wait(0.01))


def test_damage_ends_it_with_the_place(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", platoon(400))
    content = bytearray(path.read_bytes())
    content[len(content) * 3 // 5] ^= 0x10
    path.write_bytes(content)
    with playing(path) as (player, endpoint), ear(endpoint):
        player.start()
        with pytest.raises(RecordingError, match=f"{path}.*damaged"):
            eventually(lambda: player.wait(0.01))
        assert 0 < player.state().messages < 1601
        eventually(lambda: everyone(endpoint) == {"router": (1,)})
