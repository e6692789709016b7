"""Who is missed in a run of real processes, told without any."""

from typing import Any

import pytest

from maniple.cli.loading import completed
from maniple.cli.realtime import Platoon
from maniple.core.errors import RunError
from tests.cli.scenes import platoon


class Fake:
    """A process as the supervisor sees it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True

    def kill(self) -> None:
        self.alive = False

    def finish(self, until: float) -> None:
        assert not self.alive

    def epitaph(self) -> str:
        return f"{self.name} died"


class Run:
    """A platoon whose processes are not there."""

    def __init__(self, tmp_path: Any, monkeypatch: pytest.MonkeyPatch, robots: int, **changes: Any) -> None:
        self.said: list[str] = []
        scenario = completed(platoon(robots, **changes))
        self.platoon = Platoon(scenario, tmp_path / "run.mcap", 1.0, self.said.append)
        self.children: dict[str, Fake] = {}
        monkeypatch.setattr(self.platoon, "_children", self.children)
        monkeypatch.setattr(self.platoon, "_spawn", self.spawn)
        for name in ("router", "recorder", "simulator", "controller", *(r.id for r in scenario.robots)):
            self.children[name] = Fake(name)
            self.platoon._expected[name] = 1
            self.platoon._processes[name] = Named()  # type: ignore[assignment]

    def spawn(self, process: Any, life: int) -> None:
        name = next(name for name, made in self.platoon._processes.items() if made is process)
        self.children[name] = Fake(name)
        self.platoon._expected[name] = life
        self.platoon._buried.discard(name)

    def at(self, now_s: float) -> list[str]:
        """What is said until then."""
        self.platoon._listen_to_lives()
        self.platoon._play_fate(now_s)
        self.platoon._bury()
        said, self.said[:] = list(self.said), []
        return said

    def life(self, name: str, life: int, alive: bool) -> None:
        self.platoon._lives.put((name, life, alive))


class Named:
    """A row of the table of processes."""

    def again(self, life: int) -> "Named":
        return self


def test_the_scenario_kills_and_brings_back(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """While two of four are dead too few are left, but one will be back; so will a controller."""
    crashes = [
        {"node": "r2", "at_s": 1.0, "restart_after_s": 5.0},
        {"node": "r3", "at_s": 2.0},
        {"node": "controller", "at_s": 3.0, "restart_after_s": 1.0},
    ]
    run = Run(tmp_path, monkeypatch, 4, crashes=crashes)
    assert run.at(0.5) == []
    assert run.at(1.0) == ["r2 died; 3 robots go on, 1 will be back"]
    assert run.at(2.1) == ["r3 died; 2 robots go on, 1 will be back"]
    run.life("r2", 1, False)
    assert run.at(3.0) == ["controller died; it will be back"]
    assert run.at(4.0) == ["controller is started again (incarnation 2)"]
    assert run.at(6.0) == ["r2 is started again (incarnation 2)"]
    run.life("r2", 2, True)
    assert run.at(7.0) == []
    run.children["r2"].kill()
    with pytest.raises(RunError, match="r2 died"):
        run.at(8.0)


def test_a_robot_that_somebody_else_brought_back_may_be_gone_again(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, monkeypatch, 4)
    run.children["r2"].kill()
    assert run.at(1.0) == ["r2 died; 3 robots go on"]
    run.life("r2", 2, True)
    assert run.at(2.0) == ["r2 is back (incarnation 2)"]
    run.children["r3"].kill()
    assert run.at(3.0) == ["r3 died; 3 robots go on"]
    run.life("r2", 2, False)
    with pytest.raises(RunError, match=r"r2 is gone again \(incarnation 2\)"):
        run.at(4.0)


def test_a_guest_is_not_started_once_more(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(tmp_path, monkeypatch, 4, crashes=[{"node": "r2", "at_s": 1.0, "restart_after_s": 5.0}])
    run.at(1.0)
    run.life("r2", 2, True)
    assert run.at(2.0) == ["r2 is back (incarnation 2)"]
    assert run.at(6.0) == []
    assert not run.children["r2"].alive


def test_a_process_that_is_not_a_robot_is_missed_at_once(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, monkeypatch, 4)
    run.children["simulator"].kill()
    with pytest.raises(RunError, match="simulator died"):
        run.at(1.0)
