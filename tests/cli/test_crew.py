"""Who is missed in a run of real processes and who is started again, told without any."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from maniple.cli import crew as crew_module
from maniple.cli.crew import Crew
from maniple.cli.loading import completed
from maniple.cli.processes import Process, table
from maniple.core.errors import RunError
from maniple.core.faults import plan_of
from maniple.core.time import SECOND, Time, from_seconds
from maniple.host.clock import Anchor
from maniple.host.liveness import Life
from tests.cli.scenes import platoon, wired


class Fake:
    """A process as the supervisor sees it."""

    said: tuple[str, ...] = ()

    def news(self) -> tuple[str, ...]:
        said, self.said = self.said, ()
        return said

    def __init__(self, process: Process, _: bytes) -> None:
        self.process = process
        self.alive = True
        self.frozen = False
        self.pid = 7

    def kill(self) -> None:
        self.alive = False

    def finish(self, until: float) -> None:
        assert not self.alive

    def epitaph(self, consequence: str = "") -> str:
        return f"{self.process.name} died{consequence}"


class Clock(Anchor, frozen=True):
    """Stands at a time that a test sets."""

    times: list[Time] = msgspec.field(default_factory=lambda: [50 * SECOND])

    def now(self) -> Time:
        return self.times[0]


class Run:
    """A platoon whose processes are not there. Its plan begins at 0 s."""

    def __init__(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        robots: int = 4,
        keep_alive: bool = False,
        drivers: dict[str, dict[str, Any]] | None = None,
        **changes: Any,
    ) -> None:
        monkeypatch.setattr(crew_module, "Child", Fake)
        monkeypatch.setattr(crew_module, "LOOK_S", 0.0)
        monkeypatch.setattr("maniple.cli.upkeep.FIRST_S", 0.0)
        scenario = completed(wired(platoon(robots, **changes), **(drivers or {})))
        self.said: list[str] = []
        self.clock = Clock(epoch_ns=0, monotonic_ns=0)
        self.log = tmp_path / "run.mcap"
        self.crew = Crew(scenario, self.log, self.clock, keep_alive, self.said.append)
        self.plan = plan_of(scenario, 100 * SECOND)
        for stage in table(scenario, "tcp/127.0.0.1:7", "1:2:1.0", str(self.log)):
            for process in stage:
                self.crew.spawn(process)

    def child(self, name: str) -> Fake:
        found = self.crew._children[name]
        assert isinstance(found, Fake)
        return found

    def at(self, now_s: float, *dying: str) -> list[str]:
        """What is said then, when these have died."""
        self.clock.times[0] = 100 * SECOND + from_seconds(now_s)
        for name in dying:
            self.child(name).kill()
        self.crew.bury(self.plan)
        self.crew.revive(self.plan)
        self.crew.look_for_frozen()
        said, self.said[:] = list(self.said), []
        return said


PRESENTED = {"r2": {"driver": "mavlink", "presents": "mavlink"}}


@pytest.mark.parametrize("name", ["r2", "r2-driver", "r2-vehicle"])
def test_a_robot_is_lost_with_what_drives_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    run = Run(tmp_path, monkeypatch, drivers=PRESENTED)
    left = {"r2-driver": "; its vehicle may still be armed"}
    assert run.at(1.0, name) == [f"{name} died{left.get(name, '')}; 3 robots go on"]
    assert run.crew.troubles() == {name: "dead"}
    others = {"r2", "r2-driver", "r2-vehicle"} - {name}
    told = [f"{other} died{left.get(other, '')}; 3 robots go on" for other in sorted(others)]
    assert run.at(2.0, *others) == told
    with pytest.raises(RunError, match="r3 died; 2 robots are left, a formation needs 3"):
        run.at(3.0, "r3")


def test_a_driver_is_kept_alive_a_vehicle_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for what the plan says of it: that is no death of hardware."""
    crash = {"node": "r2-vehicle", "at_s": 1.0, "restart_after_s": 2.0}
    run = Run(tmp_path, monkeypatch, keep_alive=True, drivers=PRESENTED, crashes=[crash])
    killed = "r2-vehicle died, as the fault plan says; 3 robots go on, 1 will be back"
    assert run.at(1.0, "r2-vehicle") == [killed]
    assert run.at(3.0) == ["r2-vehicle is started again (incarnation 2)"]
    assert run.at(4.0, "r2-driver") == [
        "r2-driver died; 3 robots go on, 1 will be back",
        "r2-driver is started again (incarnation 2)",
    ]
    assert run.child("r2-driver").process.arguments[:3] == ("driver", "run", "r2")
    assert run.at(5.0, "r2-vehicle") == ["r2-vehicle died; 3 robots go on"]
    assert run.at(60.0) == []


def test_a_driver_that_somebody_else_brought_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(tmp_path, monkeypatch, drivers=PRESENTED)
    run.at(1.0, "r2-driver")
    run.crew.meet(Life("r2-driver", 2, True))
    assert run.at(2.0, "r3") == ["r2-driver is back (incarnation 2)", "r3 died; 3 robots go on"]


def test_what_drivers_and_vehicles_say_is_passed_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(tmp_path, monkeypatch, drivers=PRESENTED)
    run.child("r2-driver").said = ("r2-driver: the driver failed: no route to host",)
    run.child("r2-vehicle").said = ("a pilot took over",)
    run.crew.pass_on()
    assert run.said == [
        "r2-vehicle: a pilot took over",
        "r2-driver: the driver failed: no route to host",
    ]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    return Run(tmp_path, monkeypatch)


def test_what_the_plan_kills_it_brings_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While two of four are dead too few are left, but one will be back; so will a controller."""
    crashes = [
        {"node": "r2", "at_s": 1.0, "restart_after_s": 5.0},
        {"node": "r3", "at_s": 2.0},
        {"node": "controller", "at_s": 3.0, "restart_after_s": 1.0},
    ]
    run = Run(tmp_path, monkeypatch, crashes=crashes)
    assert run.at(0.5) == []
    assert run.at(1.0, "r2") == ["r2 died, as the fault plan says; 3 robots go on, 1 will be back"]
    assert run.at(2.1, "r3") == ["r3 died, as the fault plan says; 2 robots go on, 1 will be back"]
    assert run.at(3.0, "controller") == ["controller died, as the fault plan says; back after 1 s"]
    assert run.crew.troubles() == {"controller": "dead", "r2": "dead", "r3": "dead"}
    assert run.at(4.0) == ["controller is started again (incarnation 2)"]
    assert run.at(6.0) == ["r2 is started again (incarnation 2)"]
    assert run.child("r2").process.arguments[-2:] == ("--incarnation", "2")
    assert run.crew.restarts == {"controller": 1, "r2": 1}
    run.crew.meet(Life("r2", 2, True))
    assert run.at(7.0) == []
    with pytest.raises(RunError, match="r2 died; 2 robots are left, a formation needs 3"):
        run.at(8.0, "r2")


def test_kept_alive_all_come_back_and_the_recorder_in_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run-2.mcap").touch()
    run = Run(tmp_path, monkeypatch, keep_alive=True)
    run.log.touch()
    assert run.at(1.0, "router") == ["router died; it will be back", "router is started again"]
    third = tmp_path / "run-3.mcap"
    assert run.at(2.0, "recorder")[1:] == [f"recorder is started again: {third}"]
    third.touch()
    assert run.crew.logs == [run.log, third]
    assert run.child("recorder").process.arguments[-3:] == ("--log", str(run.log), "--next")
    said = run.at(3.0, "r1", "r2", "r3")
    assert said[2] == "r3 died; 1 robots go on, 3 will be back"
    assert said[3:] == [f"{name} is started again (incarnation 2)" for name in ("r1", "r2", "r3")]
    with pytest.raises(RunError, match="simulator died; a run can't go on without it"):
        run.at(4.0, "simulator")


def test_what_the_recorder_says_is_passed_on(run: Run) -> None:
    run.child("recorder").said = ("only 299 MB are free in logs",)
    run.child("r1").said = ("nobody hears",)
    for _ in range(2):
        run.crew.pass_on()
    assert run.said == ["recorder: only 299 MB are free in logs"]


def test_a_robot_that_somebody_else_brought_back_may_be_gone_again(run: Run) -> None:
    assert run.at(1.0, "r2") == ["r2 died; 3 robots go on"]
    run.crew.meet(Life("r2", 2, True))
    assert run.at(2.0, "r3") == ["r2 is back (incarnation 2)", "r3 died; 3 robots go on"]
    with pytest.raises(RunError, match=r"r2 is gone again \(incarnation 2\)"):
        run.crew.meet(Life("r2", 2, False))


def test_a_guest_is_not_started_once_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(tmp_path, monkeypatch, crashes=[{"node": "r2", "at_s": 1.0, "restart_after_s": 5.0}])
    run.at(1.0, "r2")
    run.crew.meet(Life("r2", 2, True))
    assert run.at(2.0) == ["r2 is back (incarnation 2)"]
    assert run.at(6.0) == []
    assert not run.child("r2").alive
    run.crew.meet(Life("r2", 2, False))
    assert run.at(7.0) == ["r2 is gone again (incarnation 2)", "r2 is started again (incarnation 3)"]


def test_a_second_controller_is_told_of_and_may_stay(run: Run) -> None:
    run.crew.meet(Life("controller", 2, True))
    assert run.at(1.0) == ["controller is there twice (incarnation 2)"]
    assert run.at(2.0, "controller") == ["controller died"]
    assert run.crew.troubles() == {}


def test_strangers_and_own_lives_are_no_guests(run: Run) -> None:
    for life in (Life("r1", 1, True), Life("r9", 1, True), Life("recorder", 5, True), Life("r1", 1, False)):
        run.crew.meet(life)
    assert run.at(1.0) == []


@pytest.mark.parametrize("name", ["simulator", "controller", "recorder", "router"])
def test_a_process_that_is_not_a_robot_is_missed_at_once(run: Run, name: str) -> None:
    with pytest.raises(RunError, match=f"{name} died"):
        run.at(1.0, name)


def test_who_is_frozen_is_told_once_and_again_when_it_goes_on(run: Run) -> None:
    run.child("r1").frozen = run.child("router").frozen = True
    assert run.at(1.0) == ["r1 (process 7) is frozen", "router (process 7) is frozen"]
    assert run.crew.troubles() == {"r1": "frozen", "router": "frozen"}
    assert run.at(2.0) == []
    run.child("r1").frozen = False
    assert run.at(3.0) == ["r1 (process 7) goes on"]


def test_a_death_during_the_start(run: Run) -> None:
    run.child("r1").kill()
    run.crew.require_alive({"r2", "router", "never started"})
    with pytest.raises(RunError, match="r1 died"):
        run.crew.require_alive({"r1", "r2"})
