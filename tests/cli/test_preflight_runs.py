"""Whole platoons that are looked at before they move: in virtual time, and as processes."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.loading import loads
from maniple.cli.program import app
from maniple.cli.virtual import run_virtual
from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import ScenarioError
from maniple.core.messages import Drive, EmergencyStop, FormationState, Status
from maniple.core.time import SECOND, VIRTUAL_EPOCH, Time, to_seconds
from maniple.recording.reader import read
from tests.cli.scenes import SMALL, write
from tests.cli.test_realtime import running

ASKED = "preflight.enabled=true"


def words(*spoken: tuple[float, bool]) -> tuple[tuple[Time, Envelope], ...]:
    """An operator's emergency stops (true) and releases, and when, s."""
    inputs = []
    for life, (at_s, stopped) in enumerate(spoken, 1):
        now = VIRTUAL_EPOCH + round(at_s * SECOND)
        message = EmergencyStop(stopped=stopped, source="operator", incarnation=life, stamp_ns=now)
        inputs.append((now, envelope_of(topics.STOP, codec.encode(message))))
    return tuple(inputs)


def ran(log: Path, *spoken: tuple[float, bool], text: str = SMALL, overrides: tuple[str, ...] = ()) -> Path:
    scenario = loads(text.encode(), (ASKED, *overrides))
    run_virtual(scenario, log, {}, 20.0, lambda _: None, inputs=words(*spoken))
    return log


def begun_at(log: Path) -> float:
    """When the controller first did more than wait, s."""
    return next(
        to_seconds(state.stamp_ns - VIRTUAL_EPOCH)
        for _, state in read(log).decoded(FormationState)
        if state.phase != "waiting"
    )


def test_in_virtual_time_nobody_tests_the_stop_so_that_has_to_be_done_without(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="in virtual time nobody tests the emergency stop"):
        ran(tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()
    assert begun_at(ran(tmp_path / "b.mcap", overrides=("preflight.estop=false",))) < 1.0


def test_it_begins_once_operators_have_tested_the_stop(tmp_path: Path) -> None:
    log = ran(tmp_path / "a.mcap", (2.0, True), (4.0, False))
    assert 4.0 < begun_at(log) < 4.7
    still = [
        drive for _, drive in read(log).decoded(Drive) if to_seconds(drive.stamp_ns - VIRTUAL_EPOCH) < 4.0
    ]
    assert still
    assert not any(drive.u_mps or drive.w_radps for drive in still)
    tested = {m.source: m.estop_tested for _, m in read(log).decoded(Status)}
    assert tested == dict.fromkeys(("r1", "r2", "r3"), True)


FAR = (
    SMALL.replace("end = [1.5, 0]", "end = [9, 0]")
    .replace('"r3" }]', '"r3" }, { id = "r4" }]')
    .replace("[0, -0.8]]", "[0, -0.8], [-1, 0]]")
)
CRASH = 'crashes = [{ node = "r4", at_s = 4, restart_after_s = 1 }]\ncontroller.lost_after_s = 2.0\n'


def lost_from_to(log: Path) -> list[bool]:
    """Whether r4 is in the chain, at 3, 9, and 19 s."""
    said = list(read(log).decoded(FormationState))
    return [
        any("r4" in m.chain for _, m in said if abs(to_seconds(m.stamp_ns - VIRTUAL_EPOCH) - at_s) < 0.06)
        for at_s in (3.0, 9.0, 19.0)
    ]


def test_an_agent_that_died_is_taken_in_again_once_its_stop_was_tested_too(tmp_path: Path) -> None:
    first = ((0.5, True), (1.0, False))
    assert lost_from_to(ran(tmp_path / "a.mcap", *first, text=FAR + CRASH)) == [True, False, False]
    again = ((11.0, True), (13.0, False))
    assert lost_from_to(ran(tmp_path / "b.mcap", *first, *again, text=FAR + CRASH)) == [True, False, True]
    free = ran(tmp_path / "c.mcap", text=FAR + CRASH, overrides=("preflight.estop=false",))
    assert lost_from_to(free)[::2] == [True, True]


@pytest.mark.slow
def test_a_run_tests_the_stop_by_itself_and_the_recording_proves_it(tmp_path: Path) -> None:
    """All as processes: the notice, the words on the network, and the agents' journals."""
    with running(tmp_path, write(tmp_path), "--set", ASKED, "--speed", "3") as run:
        code, result, notices = run.finish()
    assert code == 0, notices
    assert result["completed"]
    assert "emergency stop tested: 3 robots stood after" in notices
    said = [m.stopped for _, m in read(run.log).decoded(EmergencyStop)]
    assert said == sorted(said, reverse=True)
    assert set(said) == {True, False}
    proof = CliRunner().invoke(app, ["log", "verify", str(run.log)])
    assert proof.exit_code == 0, proof.output
