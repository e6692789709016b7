"""One process of a platoon: `maniple agent`, `driver run`, `controller`, `simulator`, `recorder`, `router`,
`finish`.

Parsed by the standard library: what the other commands need for theirs would take 15 MB and 0.4 s of each
process of a run.
"""

import contextlib
import os
import sys
import threading
import time
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from maniple.cli.interrupt import on_interrupt
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Links, Robot, Scenario
from maniple.host.clock import Anchor
from maniple.host.ending import end_when_asked
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession

CUT_OFF_S = 1.5
"""How much longer than its lease a life is waited for that may be over, wall time."""

POLL_S = 0.05

LOCAL = f"tcp/127.0.0.1:{DEFAULT_PORT}"

COMMANDS: Mapping[str, str] = {
    "agent": "Run the agent of one robot.",
    "controller": "Run the formation controller.",
    "simulator": "Run the simulator, which stands for the physical world.",
    "vehicle": "Show a robot of the simulator as the vehicle that it presents.",
    "recorder": "Record everything until interrupted.",
    "router": "Run a router: it relays everything and keeps the last value of every latched topic.",
    "finish": "Wait until the task is done, then end all processes of a platoon that nobody supervises.",
}
"""What each does, by name."""

DRIVER_RUN = ("driver", "run")
"""Is one of them too; the other commands of `maniple driver` are for people."""

Watch = Callable[[Callable[[], None]], None]
"""Takes what ends this process, and calls it when the supervisor is gone."""


def is_one(arguments: Sequence[str]) -> bool:
    """Whether the arguments of `maniple` name such a process."""
    return bool(arguments) and (arguments[0] in COMMANDS or tuple(arguments[:2]) == DRIVER_RUN)


def main(arguments: Sequence[str]) -> None:
    """Run the process that the arguments of `maniple` name; where they are wrong, exit with status 2.

    Raises:
        ManipleError: it can't be run.
    """
    options = vars(_parser().parse_args(arguments))
    run: Callable[..., None] = options.pop("run")
    try:
        run(**options)
    except KeyboardInterrupt:  # while it waited for others; later it is a request
        sys.exit(130)


def _parser() -> ArgumentParser:
    parser = ArgumentParser(prog="maniple", allow_abbrev=False)
    commands = parser.add_subparsers(required=True)
    made = {
        name: commands.add_parser(name, help=about, description=about, allow_abbrev=False)
        for name, about in COMMANDS.items()
    }
    made["agent"].add_argument("robot", help="id of the robot")
    made["agent"].set_defaults(run=_agent)
    made["controller"].set_defaults(run=_node, name="controller", hardware=None)
    made["simulator"].set_defaults(run=_node, name="simulator")
    made["vehicle"].add_argument("robot", help="id of the robot")
    made["vehicle"].set_defaults(run=_vehicle)
    made["vehicle"].epilog = _VEHICLE_EPILOG
    made["recorder"].set_defaults(run=_recorder)
    made["router"].set_defaults(run=_router)
    made["finish"].set_defaults(run=_finish)
    made["driver"] = _driver_parser(commands)
    for name, command in made.items():
        _add_options(name, command)
    return parser


def _driver_parser(commands: Any) -> ArgumentParser:
    group = commands.add_parser("driver", help="Drivers of robots.", allow_abbrev=False)
    about = "Run the driver of one robot: what stands between its agent and its hardware."
    command: ArgumentParser = group.add_subparsers(required=True).add_parser(
        "run", help=about, description=about, epilog=_DRIVER_EPILOG, allow_abbrev=False
    )
    command.add_argument("robot", help="id of the robot")
    command.add_argument(
        "--scans", action="store_true", help="the driver that only brings its scans, where that is another"
    )
    command.set_defaults(run=_driver)
    return command


_DRIVER_EPILOG = (
    "Stops the robot where its agent is not heard for 0.3 s, and when it is asked to end. Exit status: 0 "
    "when it was asked to end, also by SIGINT and SIGTERM; 1 when a newer life of it has taken over, or it "
    "failed; 2 bad input."
)


_VEHICLE_EPILOG = (
    "It listens at the other end of the connection in robots.mavlink, or speaks the topics in robots.ros2, "
    "for the robot's driver and whoever else comes. Exit status: 0 when it was asked to end, also by SIGINT "
    "and SIGTERM; 1 when a newer life of it has taken over, or it failed; 2 bad input, or its port is taken."
)


def _add_options(name: str, command: ArgumentParser) -> None:
    if name == "router":
        command.add_argument(
            "--scenario",
            help="for the prefix of the keys and what is wrong with the network; - reads standard input",
        )
        command.add_argument("--listen", default=LOCAL, help="where to listen (default: %(default)s)")
        command.add_argument("--prefix", default="maniple", help="of the keys, without a scenario")
        command.add_argument("--anchor", help="EPOCH:MONOTONIC:SPEED, a clock for those who join")
        return
    environment = os.environ
    command.add_argument("--scenario", required=True, help="scenario file; - reads JSON from standard input")
    command.add_argument(
        "--connect",
        default=environment.get("MANIPLE_CONNECT", LOCAL),
        help="router of the fleet network, or MANIPLE_CONNECT (default: %(default)s)",
    )
    command.add_argument(
        "--anchor",
        help="EPOCH:MONOTONIC:SPEED, the clock of a run that others take part in; by default "
        "the router tells",
    )
    command.add_argument(
        "--wait",
        type=_seconds,
        default=10.0,
        metavar="SECONDS",
        help="how long to wait for the routers at the start (default: %(default)g)",
    )
    if name != "controller":
        command.add_argument(
            "--hardware",
            default=environment.get("MANIPLE_HARDWARE"),
            help="router of the hardware network, or MANIPLE_HARDWARE, if another",
        )
    if name == "recorder":
        command.add_argument(
            "--log", type=Path, required=True, help="recording; an existing file is not overwritten"
        )
        command.add_argument(
            "--next", action="store_true", help="where it exists, go on in LOG-2.mcap, LOG-3.mcap, ..."
        )
        _add_recorder_options(command)
    elif name == "finish":
        command.add_argument(
            "--duration", type=_seconds, help="of the run at most, in scenario time; by default from the task"
        )
    else:
        command.add_argument(
            "--incarnation", type=_life, help="which life this is, from 1; by default the router tells"
        )


def _add_recorder_options(command: ArgumentParser) -> None:
    command.epilog = (
        "Exit status: 0 when it was asked to end, also by SIGINT and SIGTERM; 1 when it had to end before, "
        "as with a full disk (what was recorded can be read); 2 bad input."
    )
    add = command.add_argument
    add(
        "--split-size",
        metavar="SIZE",
        help="begin LOG-2.mcap, ... when a part has so many bytes: 500MB, 2GiB",
    )
    add("--split-time", type=_seconds, metavar="SECONDS", help="the same after so much time of the run")
    add("--compression", choices=("zstd", "none"), default="zstd", help="of the file (default: %(default)s)")
    add(
        "--topic",
        action="append",
        default=[],
        metavar="PATTERN",
        help="record these topics only; * is one level, ** any number; again for more",
    )
    add("--without", action="append", default=[], metavar="PATTERN", help="do not record these topics")
    add(
        "--min-free",
        metavar="SIZE",
        help="end in order before less than this is free on the disk (default: 200MB)",
    )
    add("--no-viz", dest="viz", action="store_false", default=None, help="leave out the channels for viewers")
    add(
        "--keep-last",
        type=_seconds,
        metavar="SECONDS",
        help="only remember this much, of the time of the run, until maniple log keep has it written to "
        "LOG-kept-1.mcap, LOG-kept-2.mcap, ...",
    )
    add("--keep-on-exit", action="store_true", help="with --keep-last: write it also at the end")


def _life(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise ArgumentTypeError(f"{text}: must be a whole number from 1")
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ArgumentTypeError(f"{text}: must be a number of seconds above 0")
    return value


def _agent(robot: str, scenario: str, **options: Any) -> None:
    resolved, watch = scenario_given(scenario)
    _run_node(robot_named(robot, resolved).id, resolved, watch, **options)


def robot_named(robot: str, scenario: Scenario) -> Robot:
    """The robot of this id.

    Raises:
        ScenarioError: there is none.
    """
    for one in scenario.robots:
        if one.id == robot:
            return one
    known = ", ".join(one.id for one in scenario.robots)
    raise ScenarioError(f"robot {robot!r} is not in the scenario; robots are {known}")


def _node(name: str, scenario: str, **options: Any) -> None:
    _run_node(name, *scenario_given(scenario), **options)


def _driver(**options: Any) -> None:
    from maniple.cli.driver_run import run

    run(**options)


def _vehicle(**options: Any) -> None:
    from maniple.cli.vehicle_run import run

    run(**options)


def _run_node(name: str, scenario: Scenario, watch: Watch, **options: Any) -> None:
    from maniple.cli.nodes import factories
    from maniple.host.realtime import RealtimeHost

    make = factories(scenario).get(name)
    if make is None:
        raise ScenarioError(f"{name}: no robot of this scenario is simulated")
    with joined(name, scenario, **options) as place:
        if place is not None:
            life, clock, fleet, hardware = place
            run_host(name, RealtimeHost(make(life), life, scenario, clock, fleet, hardware), fleet, watch)


class Place(NamedTuple):
    """A process of a platoon in it."""

    life: int
    """Which one of its name it is."""
    clock: Anchor
    fleet: ZenohSession
    hardware: ZenohSession
    """The same session where it is the same network."""


class Host(Protocol):
    """What runs such a process."""

    def run(self) -> None:
        """Until the end."""

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""


@contextlib.contextmanager
def joined(
    name: str,
    scenario: Scenario,
    connect: str,
    hardware: str | None,
    anchor: str | None,
    wait: float,
    incarnation: int | None,
) -> Iterator[Place | None]:
    """Take a place in a platoon under a name; None where the fault plan has that dead for good.

    Raises:
        ArgumentError: `anchor` is no clock.
        TransportError: the routers are not there in time, or who has this name is.
    """
    from maniple.core.faults import dies_by
    from maniple.host.fate import wait_out
    from maniple.host.joining import await_router, claim, clock_of, plan_kept

    told = _clock(anchor)
    with _networks(scenario, connect, hardware, wait) as (fleet, wired):
        await_router(fleet)
        clock = told or clock_of(fleet)
        if wait_out(name, dies_by(name, scenario), lambda: plan_kept(fleet), clock):
            life = claim(fleet, name, incarnation, scenario.network.lease_s + CUT_OFF_S)
            yield Place(life, clock, fleet, wired)
        else:
            yield None


def run_host(name: str, host: Host, fleet: ZenohSession, watch: Watch) -> None:
    """Run it until it is asked to end: by a signal, its supervisor, or over the network where it has none."""
    if watch is _nobody:
        end_when_asked(fleet, name, host.stop)
    with on_interrupt(host.stop):
        watch(host.stop)
        host.run()


def _recorder(
    scenario: str,
    log: Path,
    next: bool,
    connect: str,
    hardware: str | None,
    anchor: str | None,
    wait: float,
    keep_last: float | None,
    keep_on_exit: bool,
    **choices: Any,
) -> None:
    from maniple.cli.recorder_parts import drawing_of, require_free_name, writer_of
    from maniple.cli.recording_options import notices, options_of
    from maniple.host.fate import say, wait_out
    from maniple.host.joining import await_router, clock_of, plan_kept
    from maniple.host.recorder import RECORDER, RecorderHost
    from maniple.host.recorder_space import Space

    options = options_of(**choices)
    if keep_last is None and keep_on_exit:
        raise ArgumentError("--keep-on-exit goes with --keep-last: without that, everything is kept")
    if keep_last is not None and (options.split_bytes or options.split_s):
        raise ArgumentError("--keep-last writes no parts: leave out --split-size and --split-time")
    require_free_name(log, next or keep_last is not None)
    resolved, watch = scenario_given(scenario)
    told = _clock(anchor)
    space = Space(log.parent, options.min_free_bytes)
    space.require()
    for notice in notices(options, resolved):
        say(notice)
    with _networks(resolved, connect, hardware, wait) as (fleet, wired):
        await_router(fleet)
        clock = told or clock_of(fleet)
        if not wait_out(RECORDER, (RECORDER,), lambda: plan_kept(fleet), clock):
            return
        with contextlib.closing(writer_of(resolved, log, next, clock, options, keep_last)) as writer:
            host = RecorderHost(
                writer,
                clock,
                [fleet] if wired is fleet else [fleet, wired],
                resolved,
                takes=options.selection.takes,
                drawing=drawing_of(resolved, writer, options),
                space=space,
                keep_on_exit=keep_on_exit,
                goes_on=next and writer.paths != [log],
            )
            run_host(RECORDER, host, fleet, watch)


def _router(scenario: str | None, listen: str, prefix: str, anchor: str | None) -> None:
    from maniple.host.fate import say
    from maniple.host.router import RouterHost

    clock = _clock(anchor)
    resolved, watch = (None, _nobody) if scenario is None else scenario_given(scenario)
    links = parameters_of(Links, {"prefix": prefix}) if resolved is None else resolved.network
    hosts: list[RouterHost] = []
    ended: list[bool] = []

    def end() -> None:
        ended.append(True)
        for host in hosts:
            host.stop()

    away_s = 0.0
    while not ended:
        with ZenohSession.router(listen, links.prefix, links.lease_s) as session, on_interrupt(end):
            hosts[:] = [host := RouterHost(session, clock, resolved)]
            host.start()
            if not away_s:
                _say(f"listening on {listen}")
                watch(end)
            if watch is _nobody:
                end_when_asked(session, "router", end)
            if (away_s := host.run()) == 0.0:
                break
        say(f"router is dead by the fault plan for {away_s:.1f} s more")
        back_at = time.monotonic() + away_s
        while not ended and time.monotonic() < back_at:
            time.sleep(POLL_S)
    if host.refused:
        counts = ", ".join(f"{number} {why}" for why, number in sorted(host.refused.items()))
        say(f"refused: {counts}")


def _finish(
    scenario: str,
    connect: str,
    hardware: str | None,
    anchor: str | None,
    wait: float,
    duration: float | None,
) -> None:
    from maniple.cli.finish import Finisher
    from maniple.cli.nodes import time_limit_s
    from maniple.host.joining import clock_of

    resolved, watch = scenario_given(scenario)
    with _networks(resolved, connect, hardware, wait) as (fleet, wired):
        clock = _clock(anchor) or clock_of(fleet)
        finisher = Finisher(resolved, fleet, wired, _say)
        with on_interrupt(finisher.interrupt):
            watch(finisher.interrupt)
            if not finisher.run(time_limit_s(resolved, duration) / clock.speed):
                sys.exit(130)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


@contextlib.contextmanager
def _networks(
    scenario: Scenario, connect: str, hardware: str | None, wait_s: float
) -> Iterator[tuple[ZenohSession, ZenohSession]]:
    """Sessions on the fleet network and on the hardware one, which may be the same."""
    prefix, lease_s = scenario.network.prefix, scenario.network.lease_s
    with ZenohSession.client(connect, prefix, wait_s, lease_s) as fleet:
        if hardware is None or hardware == connect:
            yield fleet, fleet
        else:
            with ZenohSession.client(hardware, prefix, wait_s, lease_s) as wired:
                yield fleet, wired


def _clock(anchor: str | None) -> Anchor | None:
    try:
        return None if anchor is None else Anchor.parse(anchor)
    except ValueError:
        raise ArgumentError(f"--anchor {anchor}: must be EPOCH:MONOTONIC:SPEED") from None


def _nobody(_: Callable[[], None]) -> None:
    """Nobody watches over this process."""


def scenario_given(source: str) -> tuple[Scenario, Watch]:
    """The scenario, and what calls a function when the supervisor that gave it is gone."""
    from maniple.cli.loading import load, loads

    if source != "-":
        return load(Path(source)), _nobody
    return loads(_line_of_input(), form="json", source="standard input"), _when_input_ends


def _line_of_input() -> bytes:
    data = b""
    while not data.endswith(b"\n") and (part := os.read(0, 65536)):
        data += part
    if not data.strip():
        raise ScenarioError("standard input holds no scenario")
    return data


def _when_input_ends(act: Callable[[], None]) -> None:
    def wait() -> None:
        while os.read(0, 65536):
            pass
        act()

    threading.Thread(target=wait, daemon=True).start()
