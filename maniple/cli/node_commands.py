"""One process of a platoon: `maniple agent`, `controller`, `simulator`, `recorder`, `router`, `finish`.

Parsed by the standard library: what the other commands need for theirs would take 15 MB and 0.4 s of each
process of a run.
"""

import contextlib
import os
import sys
import threading
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from maniple.cli.interrupt import on_interrupt
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Links, Scenario
from maniple.host.clock import Anchor
from maniple.host.ending import end_when_asked
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession

LOCAL = f"tcp/127.0.0.1:{DEFAULT_PORT}"

COMMANDS: Mapping[str, str] = {
    "agent": "Run the agent of one robot.",
    "controller": "Run the formation controller.",
    "simulator": "Run the simulator, which stands for the physical world.",
    "recorder": "Record everything until interrupted.",
    "router": "Run a router: it relays everything and keeps the last value of every latched topic.",
    "finish": "Wait until the task is done, then end all processes of a platoon that nobody supervises.",
}
"""What each does, by name."""

Watch = Callable[[Callable[[], None]], None]
"""Takes what ends this process, and calls it when the supervisor is gone."""


def main(arguments: Sequence[str]) -> None:
    """Run the process that the arguments of `maniple` name; where they are wrong, exit with status 2.

    Raises:
        ManipleError: it can't be run.
    """
    options = vars(_parser().parse_args(arguments))
    run: Callable[..., None] = options.pop("run")
    run(**options)


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
    made["recorder"].set_defaults(run=_recorder)
    made["router"].set_defaults(run=_router)
    made["finish"].set_defaults(run=_finish)
    for name, command in made.items():
        _add_options(name, command)
    return parser


def _add_options(name: str, command: ArgumentParser) -> None:
    if name == "router":
        command.add_argument("--scenario", help="for the prefix of the keys; - reads standard input")
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
        + ("the wall clock" if name == "recorder" else "the router tells"),
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
    elif name == "finish":
        command.add_argument(
            "--duration", type=_seconds, help="of the run at most, in scenario time; by default from the task"
        )
    else:
        command.add_argument(
            "--incarnation", type=_life, help="which life this is, from 1; by default the router tells"
        )


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


def _agent(
    robot: str, scenario: str, connect: str, hardware: str | None, anchor: str | None, incarnation: int | None
) -> None:
    resolved, watch = _scenario(scenario)
    known = [one.id for one in resolved.robots]
    if robot not in known:
        raise ScenarioError(f"robot {robot!r} is not in the scenario; robots are {', '.join(known)}")
    _run_node(robot, resolved, watch, connect, hardware, anchor, incarnation)


def _node(
    name: str, scenario: str, connect: str, hardware: str | None, anchor: str | None, incarnation: int | None
) -> None:
    _run_node(name, *_scenario(scenario), connect, hardware, anchor, incarnation)


def _run_node(
    name: str,
    scenario: Scenario,
    watch: Watch,
    connect: str,
    hardware: str | None,
    anchor: str | None,
    incarnation: int | None,
) -> None:
    from maniple.cli.nodes import factories
    from maniple.host.realtime import RealtimeHost
    from maniple.host.router import clock_of, next_incarnation

    told = _clock(anchor)
    with _networks(scenario, connect, hardware) as (fleet, wired):
        clock = told or clock_of(fleet)
        life = incarnation if incarnation is not None else next_incarnation(fleet, name)
        host = RealtimeHost(factories(scenario)[name](life), life, scenario, clock, fleet, wired)
        if watch is _nobody:
            end_when_asked(fleet, name, host.stop)
        with on_interrupt(host.stop):
            watch(host.stop)
            host.run()


def _recorder(scenario: str, log: Path, connect: str, hardware: str | None, anchor: str | None) -> None:
    from maniple.cli.machine import describe_machine
    from maniple.core.scenario.parse import to_json
    from maniple.host.recorder import RecorderHost
    from maniple.recording.writer import RecordingWriter

    resolved, watch = _scenario(scenario)
    clock = _clock(anchor) or Anchor.here()
    writer = RecordingWriter(
        log,
        to_json(resolved),
        describe_machine(resolved, "realtime"),
        prefix=resolved.network.prefix,
        now=clock.now(),
    )
    with writer, _networks(resolved, connect, hardware) as (fleet, wired):
        host = RecorderHost(writer, clock, [fleet] if wired is fleet else [fleet, wired])
        if watch is _nobody:
            end_when_asked(fleet, "recorder", host.stop)
        with on_interrupt(host.stop):
            watch(host.stop)
            host.run()


def _router(scenario: str | None, listen: str, prefix: str, anchor: str | None) -> None:
    from maniple.host.router import RouterHost

    clock = _clock(anchor)
    watch: Watch = _nobody
    if scenario is None:
        links = parameters_of(Links, {"prefix": prefix})
    else:
        resolved, watch = _scenario(scenario)
        links = resolved.network
    with ZenohSession.router(listen, links.prefix) as session:
        sys.stdout.write(f"listening on {listen}\n")
        sys.stdout.flush()
        host = RouterHost(session, clock)
        if watch is _nobody:
            end_when_asked(session, "router", host.stop)
        with on_interrupt(host.stop):
            watch(host.stop)
            host.run()


def _finish(
    scenario: str, connect: str, hardware: str | None, anchor: str | None, duration: float | None
) -> None:
    from maniple.cli.finish import Finisher
    from maniple.cli.nodes import time_limit_s
    from maniple.host.router import clock_of

    resolved, watch = _scenario(scenario)
    with _networks(resolved, connect, hardware) as (fleet, wired):
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
    scenario: Scenario, connect: str, hardware: str | None
) -> Iterator[tuple[ZenohSession, ZenohSession]]:
    """Sessions on the fleet network and on the hardware one, which may be the same."""
    prefix = scenario.network.prefix
    with ZenohSession.client(connect, prefix) as fleet:
        if hardware is None or hardware == connect:
            yield fleet, fleet
        else:
            with ZenohSession.client(hardware, prefix) as wired:
                yield fleet, wired


def _clock(anchor: str | None) -> Anchor | None:
    try:
        return None if anchor is None else Anchor.parse(anchor)
    except ValueError:
        raise ArgumentError(f"--anchor {anchor}: must be EPOCH:MONOTONIC:SPEED") from None


def _nobody(_: Callable[[], None]) -> None:
    """Nobody watches over this process."""


def _scenario(source: str) -> tuple[Scenario, Watch]:
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
