"""Whether robots have done what an emergency stop, or its release, asks for."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from maniple.cli.operator import AGAIN_S, latched, operator_session
from maniple.cli.program import app
from maniple.cli.stop_command import Confirmed, Witness, confirm, words
from maniple.core import codec, topics
from maniple.core.errors import RunError
from maniple.core.messages import EmergencyStop, Odometry, Status
from maniple.host.clock import Anchor
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.transport.test_zenoh import DEADLINE_S, free_port

STOP = EmergencyStop(stopped=True, reason="a test")


def status(mode: str, **head: Any) -> Status:
    return Status(
        mode=mode,  # type: ignore[arg-type]
        guard="none",
        command_age_s=0.0,
        command_age_max_s=0.0,
        driver="active",
        reason="",
        counters={},
        **head,
    )


def odometry(u: float = 0.0, w: float = 0.0, v: float = 0.0, **head: Any) -> Odometry:
    return Odometry(frame_id="r1", x_m=0, y_m=0, psi_rad=0, u_mps=u, w_radps=w, v_mps=v, **head)


def test_a_robot_has_stopped_when_it_says_so_and_stands_since() -> None:
    one = Witness(stopped=True)
    assert one.doubt == "has not said how it is"
    one.heard(odometry(), 0.0)
    one.heard(status("tracking"), 0.1)
    assert one.doubt == "is tracking"
    one.heard(status("emergency"), 0.2)
    assert one.at is None
    one.heard(odometry(u=-0.2, w=0.1), 0.3)
    assert one.doubt == "still moves, 0.20 m/s, 0.10 rad/s"
    one.heard(odometry(v=0.05), 0.4)
    one.heard(odometry(w=0.05), 0.5)
    assert one.at is None
    one.heard(odometry(u=0.001), 0.6)
    one.heard(odometry(), 0.7)
    assert one.at == 0.6


def test_one_that_lives_anew_has_to_say_it_again() -> None:
    one = Witness(stopped=True)
    one.heard(status("emergency"), 0.1)
    one.heard(odometry(), 0.2)
    one.heard(status("waiting"), 0.3)
    assert (one.at, one.doubt) == (None, "is waiting")


def test_a_robot_is_armed_when_it_says_that_it_is_in_no_emergency() -> None:
    one = Witness(stopped=False)
    one.heard(odometry(), 0.0)
    one.heard(status("emergency"), 0.1)
    assert (one.at, one.doubt) == (None, "is emergency")
    one.heard(status("waiting"), 0.2)
    one.heard(status("tracking"), 0.3)
    assert one.at == 0.2


def test_people_are_told_who_did_and_who_did_not() -> None:
    found = Confirmed(
        stopped=True,
        ok=False,
        confirmed={"r1": 0.25},
        missing={"r2": "still moves, 0.20 m/s, 0.00 rad/s"},
        absent=("r3",),
        kept=False,
        overruled=True,
        connect="tcp/h:1",
    )
    assert words(found).splitlines() == [
        "r1 stands, after 0.25 s",
        "r2 does not confirm: it still moves, 0.20 m/s, 0.00 rad/s",
        "r3 is not there; it is told when it is back",
        "the router does not keep it: robots that come later are not told",
        "another operator has said something since (tcp/h:1)",
    ]
    nobody = Confirmed(
        stopped=False,
        ok=False,
        confirmed={},
        missing={},
        absent=(),
        kept=True,
        overruled=False,
        connect="tcp/h:1",
    )
    assert words(nobody) == "no robot is there (tcp/h:1)"


# -- with a real router, and robots played by sessions


class Played:
    """A robot that hears the stop and says, when told to, how it is."""

    def __init__(self, endpoint: str, name: str) -> None:
        self.session = ZenohSession.client(endpoint, "maniple")
        self.heard: list[EmergencyStop] = []
        self._name = name
        self._seq = 0
        self.session.subscribe(topics.STOP, self._hear)
        self.session.settle()
        self.session.announce(name, 1)

    def says(self, mode: str, **velocity: float) -> None:
        """Its status and its odometry."""
        self._seq += 1
        head: dict[str, Any] = {"source": self._name, "incarnation": 1, "seq": self._seq}
        self.session.put(topics.status(self._name), codec.encode(status(mode, **head)))
        self.session.put(topics.odometry(self._name), codec.encode(odometry(**velocity, **head)))

    def _hear(self, _: str, data: bytes) -> None:
        message = codec.decode(topics.STOP, data)
        assert isinstance(message, EmergencyStop)
        self.heard.append(message)


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple") as router:
        serve(router, Anchor.here())
        yield address


@contextmanager
def saying(robot: Played, after: int, mode: str, **velocity: float) -> Iterator[None]:
    """The robot says how it is, over and over, once it has heard the operator `after` times."""
    end = threading.Event()

    def say() -> None:
        while not end.wait(0.05):
            if len(robot.heard) >= after:
                robot.says(mode, **velocity)
            else:
                robot.says("tracking", u=0.3)

    thread = threading.Thread(target=say)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def test_it_is_said_until_the_last_robot_stands_and_stays_said(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    with one.session, two.session, operator_session(endpoint, "maniple", DEADLINE_S) as session:
        with saying(one, 1, "emergency"), saying(two, 3, "emergency"):
            found = confirm(session, STOP, DEADLINE_S)
        assert (found.ok, found.missing, found.absent, found.overruled) == (True, {}, (), False)
        assert found.confirmed["r1"] < found.confirmed["r2"]
        assert found.confirmed["r2"] > 1.5 * AGAIN_S
        assert len({said.incarnation for said in two.heard}) == 1
        assert [said.seq for said in two.heard] == list(range(len(two.heard)))
        kept = latched(session, topics.STOP)
        assert isinstance(kept, EmergencyStop)
        assert (kept.stopped, kept.reason, kept.source) == (True, "a test", "operator")


def test_who_does_not_stand_is_named(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")
    with (
        one.session,
        two.session,
        saying(one, 1, "emergency"),
        saying(two, 1, "emergency", u=0.2),
        operator_session(endpoint, "maniple", DEADLINE_S) as session,
    ):
        found = confirm(session, STOP, 1.5)
    assert (found.ok, list(found.confirmed)) == (False, ["r1"])
    assert found.missing == {"r2": "still moves, 0.20 m/s, 0.00 rad/s"}


def test_another_operator_who_speaks_later_is_told_of(endpoint: str) -> None:
    one = Played(endpoint, "r1")
    later = EmergencyStop(stopped=False, source="operator", incarnation=2**61)
    with one.session, operator_session(endpoint, "maniple", DEADLINE_S) as session:
        overrule = threading.Timer(0.5, lambda: one.session.put(topics.STOP, codec.encode(later)))
        overrule.start()
        with saying(one, 1, "waiting"):
            found = confirm(session, STOP, 2.0)
        overrule.join()
    assert (found.ok, found.overruled, found.missing) == (False, True, {"r1": "is waiting"})


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_commands(endpoint: str) -> None:
    one = Played(endpoint, "r1")
    with one.session, saying(one, 1, "emergency"):
        stopped = invoke("stop", "--reason", "a dog", "--connect", endpoint)
        assert (stopped.exit_code, stopped.stdout.split(",")[0]) == (0, "r1 stands")
        refused = invoke("arm", "--connect", endpoint, "--timeout", 1, "--json")
        assert refused.exit_code == 1
        assert json.loads(refused.stdout)["missing"] == {"r1": "is emergency"}
        assert [said.stopped for said in one.heard[:1]] == [True]
        assert not one.heard[-1].stopped


def test_without_robots_it_is_kept_for_them_but_not_done(endpoint: str) -> None:
    found = invoke("stop", "--connect", endpoint, "--timeout", 0.5, "--json")
    assert found.exit_code == 1
    said = json.loads(found.stdout)
    assert (said["ok"], said["kept"], said["confirmed"], said["connect"]) == (False, True, {}, endpoint)
    assert (
        invoke("stop", "--connect", endpoint, "--timeout", 0.5).stdout == f"no robot is there ({endpoint})\n"
    )


def test_nobody_there_is_a_failure() -> None:
    nowhere = invoke("stop", "--connect", "tcp/127.0.0.1:1", "--timeout", 0.3)
    assert isinstance(nowhere.exception, RunError)
    assert "\nno stop was given: robots of a platoon that can't be reached stand, by" in str(
        nowhere.exception
    )
    unarmed = invoke("arm", "--connect", "tcp/127.0.0.1:1", "--timeout", 0.3)
    assert isinstance(unarmed.exception, RunError)
    assert "no stop was given" not in str(unarmed.exception)
    assert invoke("arm", "--connect", "localhost").exit_code == 2
