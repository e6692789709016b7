"""The table of processes, and real children of the supervisor."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from maniple.cli.loading import completed
from maniple.cli.processes import Child, Process, finish_all, stop_order, table
from maniple.cli.realtime import STOP_WITHIN_S
from maniple.core.errors import RunError
from tests.cli.scenes import ROOT, platoon, wired
from tests.waiting import eventually, runs

SCENARIO = b'{"name": "x"}'
READ_LINE = "import sys; line = sys.stdin.readline()\n"


@contextmanager
def child(code: str, scenario: bytes = SCENARIO) -> Iterator[Child]:
    """A child that runs some Python in place of `maniple`."""
    made = Child(Process("x", (code,)), scenario, program=(sys.executable, "-c"))
    try:
        yield made
    finally:
        made.finish(time.monotonic())


def test_the_table_lists_a_process_for_each_node() -> None:
    scenario = completed(platoon(4))
    stages = table(scenario, "tcp/127.0.0.1:7", "1:2:3.0", "a.mcap")
    assert [[process.name for process in stage] for stage in stages] == [
        ["router"],
        ["recorder"],
        ["simulator", "r1", "r2", "r3", "r4", "controller"],
    ]
    for process in (p for stage in stages for p in stage):
        assert process.arguments[0] == (
            "agent" if process.name.startswith("r") and process.name[1:].isdigit() else process.name
        )
        assert "tcp/127.0.0.1:7" in process.arguments
    assert stages[2][1].arguments[:2] == ("agent", "r1")


def test_everybody_is_stopped_once_the_recorder_after_all_it_records() -> None:
    scenario = completed(platoon(4))
    order = [name for names in stop_order(scenario).values() for name in names]
    started = [p.name for stage in table(scenario, "c", "a", "l") for p in stage]
    assert sorted(order) == sorted(started)
    assert order[-2:] == ["recorder", "router"]
    assert order.index("controller") < order.index("r1") < order.index("simulator")


def test_drivers_come_before_agents_and_after_their_vehicles_and_go_the_other_way_round() -> None:
    presented = {"driver": "mavlink", "presents": "mavlink"}
    scenario = completed(wired(platoon(3), r1={"scans": "ros2"}, r2=presented, r3={"driver": "ros2"}))
    stages = table(scenario, "c", "a", "l")
    assert [[process.name for process in stage] for stage in stages[2:]] == [
        ["simulator", "r2-vehicle"],
        ["r2-driver", "r3-driver", "r1-scanner"],
        ["r1", "r2", "r3", "controller"],
    ]
    by_name = {process.name: process.arguments for stage in stages for process in stage}
    assert by_name["r2-vehicle"][:2] == ("vehicle", "r2")
    assert by_name["r3-driver"][:3] == ("driver", "run", "r3")
    assert by_name["r1-scanner"][:4] == ("driver", "run", "r1", "--scans")
    order = stop_order(scenario)
    assert list(order) == ["controller", "agents", "drivers", "vehicles", "simulator", "recorder", "router"]
    assert sorted(name for names in order.values() for name in names) == sorted(by_name)
    assert set(order) == set(STOP_WITHIN_S)


def test_where_no_robot_has_a_body_there_is_no_simulator() -> None:
    scenario = completed(wired(platoon(3), **{f"r{k}": {"driver": "ros2"} for k in (1, 2, 3)}))
    stages = table(scenario, "c", "a", "l")
    assert [[process.name for process in stage] for stage in stages[2:]] == [
        ["r1-driver", "r2-driver", "r3-driver"],
        ["r1", "r2", "r3", "controller"],
    ]
    assert "simulator" not in stop_order(scenario)
    assert "vehicles" not in stop_order(scenario)


def test_a_child_is_given_the_scenario_and_is_heard() -> None:
    with child(READ_LINE + "print(line, flush=True); sys.stdin.read()") as made:
        assert made.alive
        assert made.spoke(30.0)
        assert "still runs" in made.epitaph()


def test_what_a_child_says_is_news_once() -> None:
    """Of one that fails it is for its epitaph."""
    code = (
        READ_LINE + "print('low disk', file=sys.stderr, flush=True); print(1, flush=True); sys.stdin.read()"
    )
    with child(code) as made:
        assert eventually(lambda: list(made.news())) == ["low disk"]
        assert list(made.news()) == []
    with child(READ_LINE + "sys.exit('no disk')") as made:
        eventually(lambda: not made.alive and "no disk" in made.epitaph())
        assert list(made.news()) == []


def test_a_flag_is_given_once() -> None:
    process = Process("recorder", ("recorder", "--log", "a.mcap"))
    assert process.also("--next").also("--next").arguments == (*process.arguments, "--next")


def test_the_recorder_is_told_how_to_record() -> None:
    stages = table(completed(platoon(3)), "c", "a", "l", ("--no-viz", "--split-time", "60"))
    assert stages[1][0].arguments[-5:] == ("--log", "l", "--no-viz", "--split-time", "60")


def test_a_child_that_says_nothing_is_not_waited_for_longer_than_asked() -> None:
    with child("import sys; sys.stdin.read()") as made:
        assert not made.spoke(0.01)


def test_a_scenario_larger_than_a_pipe_does_not_block() -> None:
    size = 3_000_000
    code = READ_LINE + "print(len(line), file=sys.stderr); sys.exit(len(line) % 256)"
    with child(code, b"x" * size) as made:
        eventually(lambda: not made.alive)
        assert str(size + 1) in made.epitaph()


def test_last_words_of_one_that_fails() -> None:
    with child("import sys; print('one'); print('two\\nthree', file=sys.stderr); sys.exit(3)") as made:
        eventually(lambda: not made.alive)
        assert (
            made.epitaph() == f"x (process {made.pid}) ended with status 3; its last words:\n  two\n  three"
        )


def test_only_the_last_of_many_words_are_kept() -> None:
    with child("import sys\nfor i in range(1000): print('word', i, file=sys.stderr)") as made:
        eventually(lambda: not made.alive)
        words = made.epitaph().splitlines()[1:]
    assert words == [f"  word {i}" for i in range(980, 1000)]


def test_words_need_not_be_text() -> None:
    with child("import sys; sys.stderr.buffer.write(b'\\xff\\xfe!')") as made:
        eventually(lambda: not made.alive)
        assert made.epitaph().endswith("!")


def test_one_that_was_killed_says_by_what() -> None:
    with child("import sys; sys.stdin.read()") as made:
        os.kill(made.pid, signal.SIGKILL)
        eventually(lambda: not made.alive)
        assert made.epitaph() == f"x (process {made.pid}) was killed by SIGKILL"


def test_its_input_ends_when_it_is_let_go() -> None:
    """What tells an orphan that its supervisor is gone."""
    code = READ_LINE + "print(1, flush=True); sys.stdin.read(); sys.exit(7)"
    supervisor = f"""
import os, signal, sys
from maniple.cli.processes import Child, Process
child = Child(Process("x", ({code!r},)), b"", program=(sys.executable, "-c"))
child.spoke(30.0)
print(child.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", supervisor], stdout=subprocess.PIPE, cwd=ROOT, check=False)
    assert killed.returncode == -signal.SIGKILL
    pid = int(killed.stdout)
    eventually(lambda: not runs(pid))


def test_a_willing_child_ends_by_itself() -> None:
    code = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(5))
print(1, flush=True)
while True: time.sleep(60)
"""
    with child(code) as made:
        assert made.spoke(30.0)
        finish_all([made], time.monotonic() + 30)
        assert "ended with status 5" in made.epitaph()


def test_one_that_does_not_listen_is_ended_by_force_and_keeps_nobody_waiting() -> None:
    deaf = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
print(1, flush=True)
while True: time.sleep(60)
"""
    willing = deaf.replace("signal.SIG_IGN", "lambda *_: sys.exit(5)")
    with child(deaf) as first, child(willing) as second:
        assert first.spoke(30.0)
        assert second.spoke(30.0)
        begin = time.monotonic()
        finish_all([first, second], begin + 1.0)
        assert 0.9 < time.monotonic() - begin < 20.0
        assert "killed by SIGKILL" in first.epitaph()
        assert "ended with status 5" in second.epitaph()


def test_one_that_is_frozen_is_thawed_to_finish() -> None:
    code = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(5))
print(1, flush=True)
while True: time.sleep(60)
"""
    with child(code) as made:
        assert made.spoke(30.0)
        os.kill(made.pid, signal.SIGSTOP)
        finish_all([made], time.monotonic() + 30)
        assert "ended with status 5" in made.epitaph()


def test_finishing_the_dead_is_fine() -> None:
    with child("pass") as made:
        eventually(lambda: not made.alive)
        finish_all([made], time.monotonic() + 30)
        made.finish(time.monotonic())
        assert "ended with status 0" in made.epitaph()


def test_no_program_to_start() -> None:
    with pytest.raises(RunError, match="x could not be started: No such file"):
        Child(Process("x", ()), SCENARIO, program=("/nowhere/python",))


def test_another_value_of_an_option() -> None:
    process = Process("r1", ("agent", "r1", "--incarnation", "1", "--log", "a"))
    assert process.having("--incarnation", "2").arguments == (
        "agent",
        "r1",
        "--incarnation",
        "2",
        "--log",
        "a",
    )
    assert process.having("--log", "b").arguments[-1] == "b"
    assert Process("router", ("router",)).having("--incarnation", "2") == Process("router", ("router",))


def test_one_that_is_frozen_is_told_from_one_that_runs_or_is_dead() -> None:
    with child("import sys; sys.stdin.read()") as made:
        assert not made.frozen
        os.kill(made.pid, signal.SIGSTOP)
        eventually(lambda: made.frozen)
        assert made.alive
        os.kill(made.pid, signal.SIGCONT)
        eventually(lambda: not made.frozen)
        os.kill(made.pid, signal.SIGKILL)
        eventually(lambda: not made.alive)
        assert not made.frozen


def test_what_comes_of_an_end_is_told_before_the_last_words() -> None:
    with child("import sys; sys.exit('alas')") as made:
        eventually(lambda: not made.alive)
        assert made.epitaph("; so be it").endswith("ended with status 1; so be it; its last words:\n  alas")
