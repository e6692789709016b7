"""`maniple log play`, and `maniple log player`, which tells a play from outside what to do."""

import os
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from select import select
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import typer
from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from maniple.cli.interrupt import on_interrupt
from maniple.cli.log.options import From, Topics, Until, Without, selection_of
from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import Connect, Json, Prefix, Timeout, operator_session
from maniple.core.errors import ArgumentError, RunError, TransportError
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Links
from maniple.host.clock import FASTEST, SLOWEST
from maniple.recording.reader import Recording, read

if TYPE_CHECKING:
    from maniple.host.player import Player, Playing
    from maniple.transport.zenoh import ZenohSession

_POLL_S = 0.05
_LINE_EVERY_S = 10.0
_END_WITHIN_S = 2.0
"""How long an interrupted play may wait for a listener that does not read."""
_PORTS = 3
CONNECT_S = 5.0
"""How long a router is waited for."""
_KEYS = "space: pause, s: step, q: end"


def play(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    connect: Annotated[
        str | None,
        typer.Option(
            help="Router to play onto; by default this is one itself.",
            show_default=False,
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Where to be a router; by default tcp/127.0.0.1:7447, or another port if that is taken.",
            show_default=False,
        ),
    ] = None,
    prefix: Annotated[
        str | None, typer.Option(help="Of the keys; by default that of the recording.", show_default=False)
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Times the recording's time; by default 1.", show_default=False)
    ] = None,
    as_fast_as_possible: Annotated[
        bool, typer.Option("--as-fast-as-possible", help="As fast as those who listen can take it.")
    ] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again, until interrupted.")] = False,
    times: Annotated[int, typer.Option(min=1, help="So many times.")] = 1,
    paused: Annotated[bool, typer.Option("--paused", help="Begin with a pause.")] = False,
    linger: Annotated[
        float,
        typer.Option(
            min=0.0, max=86_400.0, help="Stay for so many seconds after the end, for who is behind."
        ),
    ] = 1.0,
    start: From = None,
    until: Until = None,
    topic: Topics = None,
    without: Without = None,
    onto_live_nodes: Annotated[
        bool,
        typer.Option(
            "--onto-live-nodes",
            help="Even where nodes live. What orders them (commands, drives, goals, stops, fault plans), and "
            "what they say themselves, is left out unless a --topic names it.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Play a recording onto the network, as if its nodes lived.

    On a terminal: space pauses and goes on, s steps by one message, q ends. From outside: maniple log player.

    Exit status: 0 played to the end, 1 it could not be (a node came to life there, the router went away),
    2 bad input, or nodes live there, 130 interrupted.
    """
    from maniple.host.player import How, Player

    if as_fast_as_possible and rate is not None:
        raise ArgumentError("--rate and --as-fast-as-possible exclude each other")
    if rate is not None and not SLOWEST <= rate <= FASTEST:
        raise ArgumentError(f"--rate {rate:g}: must be from {SLOWEST:g} to {FASTEST:g}")
    if connect is not None and listen is not None:
        raise ArgumentError("--connect and --listen exclude each other")
    if loop and times != 1:
        raise ArgumentError("--loop and --times exclude each other")
    recording = read(file)
    selection = selection_of(recording, start, until, topic, without)
    key = parameters_of(Links, {"prefix": recording.prefix if prefix is None else prefix}).prefix
    how = How(
        rate=None if as_fast_as_possible else rate or 1.0,
        times=None if loop else times,
        paused=paused,
        linger_s=linger,
        onto_live_nodes=onto_live_nodes,
    )
    console = Console(stderr=True)
    with ExitStack() as stack:
        session, endpoint = _session(connect, listen, key)
        stack.callback(session.close)
        player = Player(recording, selection, session, connect is None, how)
        interrupted = _run(player, recording, console, f"{endpoint}, keys under {key}")
        found = player.state()
        if as_json:
            about = {"file": str(file), "connect": endpoint, "prefix": key, "interrupted": interrupted}
            typer.echo(msgspec.json.encode({**about, **msgspec.structs.asdict(found)}))
        else:
            typer.echo(_summary(found))
        if interrupted and not player.wait(0.0):
            sys.stdout.flush()
            os._exit(130)  # to close the session would take as long as the listener that does not read
    raise typer.Exit(130 if interrupted else 0)


def player(
    order: Annotated[
        Literal["status", "pause", "resume", "step"], typer.Argument(help="What the play is to do.")
    ],
    count: Annotated[
        int | None,
        typer.Option(min=1, max=1_000_000, help="Messages of a step; by default 1.", show_default=False),
    ] = None,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Tell a `maniple log play` to pause, to go on, or to step, or ask how far it is.

    Exit status: 0 it was told, 1 nothing is played there, 2 bad input.
    """
    from maniple.host.player import Playing

    if count is not None and order != "step":
        raise ArgumentError(f"--count is for step, not for {order}")
    name = f"play/step/{count or 1}" if order == "step" else f"play/{order}"
    with operator_session(connect, prefix, timeout) as session:
        answer = session.ask(name, timeout).get(name)
        if answer is None:
            raise RunError(f"no recording is played under the prefix {prefix}")
        try:
            found = msgspec.json.decode(answer, type=Playing)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            raise RunError("what answers there is no maniple log play of this version") from None
    typer.echo(msgspec.json.encode(found) if json else _line(found))


def _session(connect: str | None, listen: str | None, prefix: str) -> tuple["ZenohSession", str]:
    """A session on the router that was given, or one that is a router, and where that is.

    Raises:
        RunError: it can't be reached, or there is no free port.
        TransportError: it can't listen there.
        BadParameter: it is no endpoint.
    """
    from maniple.cli.operator import require_endpoint
    from maniple.cli.realtime import free_endpoint
    from maniple.host.player import PATIENCE_S
    from maniple.transport.zenoh import ZenohSession

    if connect is not None:
        require_endpoint(connect)
        try:
            return ZenohSession.client(connect, prefix, CONNECT_S, patience_s=PATIENCE_S), connect
        except TransportError as error:
            raise RunError(str(error)) from None
    if listen is not None:
        require_endpoint(listen, "--listen")
        return ZenohSession.router(listen, prefix, patience_s=PATIENCE_S), listen
    for attempt in range(1, _PORTS + 1):
        endpoint = free_endpoint()
        try:
            return ZenohSession.router(endpoint, prefix, patience_s=PATIENCE_S), endpoint
        except TransportError as error:  # somebody took the port in between
            if attempt == _PORTS:
                raise RunError(str(error)) from None
    raise AssertionError


def _run(player: "Player", recording: Recording, console: Console, where: str) -> bool:
    """Play and show it, and do what keys say; whether it was interrupted."""
    asked: list[bool] = []

    def interrupt() -> None:
        asked.append(True)
        player.stop()

    def say(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    say(f"plays {recording.path} onto {where}")
    if not recording.complete:
        say("the recording is not finished: it is played up to where it stops being whole")
    if player.left_out:
        say(f"left out, as nodes live there: {', '.join(player.left_out)}")
    with on_interrupt(interrupt), _keys() as pressed, _shown(console) as show:
        player.start()
        while not (player.wait(0.0 if pressed.waits else _POLL_S) or asked):
            _obey(pressed(), player, interrupt)
            show(player.state())
        if asked:
            player.wait(_END_WITHIN_S)
    return bool(asked)


def _obey(keys: str, player: "Player", interrupt: Callable[[], None]) -> None:
    for key in keys:
        if key == " ":
            player.toggle()
        elif key in "s.":
            player.step()
        elif key == "q":
            interrupt()


class _Keyboard:
    """What is pressed on a terminal; nothing where there is none."""

    def __init__(self, waits: bool) -> None:
        self.waits = waits
        """Whether asking for keys takes a moment."""

    def __call__(self) -> str:
        if self.waits and select([sys.stdin], [], [], _POLL_S)[0]:
            keys = os.read(sys.stdin.fileno(), 64)
            self.waits = bool(keys)
            return keys.decode("ascii", "ignore")
        return ""


@contextmanager
def _keys() -> Iterator[_Keyboard]:
    """Single keys, for as long as the block."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        yield _Keyboard(waits=False)
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield _Keyboard(waits=True)
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


@contextmanager
def _shown(console: Console) -> Iterator[Callable[["Playing"], None]]:
    """Shows how far it is: as a bar on a terminal, elsewhere as a line now and then."""
    if console.is_terminal:
        with Live(console=console, auto_refresh=False, transient=True) as live:
            yield lambda state: live.update(_picture(state), refresh=True)
        return
    due = [time.monotonic() + _LINE_EVERY_S]

    def show(state: "Playing") -> None:
        if time.monotonic() >= due[0]:
            due[0] += _LINE_EVERY_S
            console.print(_line(state), highlight=False, markup=False, soft_wrap=True)

    yield show


def _picture(state: "Playing") -> Table:
    table = Table.grid(padding=(0, 2))
    length = max(state.end_s, 1e-9)
    table.add_row(
        Text("paused", style="yellow") if state.paused else Text("playing", style="green"),
        ProgressBar(total=length, completed=state.position_s, width=30),
        Text(_line(state)),
        Text(_KEYS, style="dim"),
    )
    return table


def _line(state: "Playing") -> str:
    asked = "as fast as possible" if state.rate is None else f"rate {state.rate:g}"
    round_ = f", round {state.loops + 1}" if state.loops else ""
    pause = ", paused" if state.paused else ""
    return (
        f"{state.position_s:.1f} of {state.end_s:.1f} s{round_}, {state.messages} messages, "
        f"{asked} ({state.reached_rate:.2f} reached){pause}"
    )


def _summary(state: "Playing") -> str:
    slowed = f"; could not keep up: {state.slowed_s:.2f} s longer" if state.slowed_s else ""
    return (
        f"{state.messages} messages ({state.bytes} bytes), {state.recorded_s:.3f} s of the recording in "
        f"{state.wall_s:.3f} s: {state.reached_rate:.2f} times its time; at most "
        f"{1000 * state.lag_max_s:.1f} ms late{slowed}"
    )
