"""`maniple log verify`."""

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli.interrupt import on_interrupt

if TYPE_CHECKING:
    from maniple.cli.log.proving import Progress, Verification
    from maniple.host.verification import Divergence, Input, Proof

_WIDEST = 300
"""Characters of a message in a trace."""

_COLOURS = {"identical": "green", "within tolerance": "green", "diverges": "red", "unproved": "yellow"}


def verify(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    node: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE",
            help="Only this node (r3, controller, simulator); may be repeated.",
            show_default=False,
        ),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[FIELD=]NUMBER",
            help="How far floats may be off, absolute below 1 and relative above; FIELD=NUMBER for one field "
            "(x_m=1e-6, Odometry.ticks=1, counters=inf), whole numbers only so. May be repeated. "
            "By default not a bit.",
            show_default=False,
        ),
    ] = None,
    trace: Annotated[int, typer.Option(min=0, help="Calls to show before the first divergence.")] = 10,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; by default one for each core.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run nodes again from a recording's journals and messages, and compare every byte they send.

    Every life of a node is called as its journal says, with the recorded messages. What a killed process had
    not journaled yet (its last 0.2 s) is unproved, and no failure. An input that the recording lacks, or that
    it has with other bytes than the node got, is one.

    Exit status: 0 all that they send is as recorded, or within the tolerance, 1 it is not, or can't be
    proved, 2 bad input, 130 interrupted.
    """
    from maniple.cli.log.proving import Order, StoppedError
    from maniple.cli.log.proving import verify as verified
    from maniple.recording.compare import tolerance_of

    order = Order(file, tolerance_of(tolerance or ()), trace)
    console = Console(stderr=True)
    stopped = False

    def stop() -> None:
        nonlocal stopped
        stopped = True

    begin = time.perf_counter()
    with on_interrupt(stop), console.status("") as status:

        def tell(progress: "Progress") -> None:
            status.update(f"{progress.done} of {progress.nodes} nodes run again")

        try:
            found = verified(order, node or (), jobs, lambda: stopped, tell)
        except StoppedError:
            raise typer.Exit(130) from None
    wall_s = time.perf_counter() - begin
    if as_json:
        typer.echo(msgspec.json.encode(_figures(found, wall_s)))
    else:
        _tell(found, wall_s)
    raise typer.Exit(0 if found.holds else 1)


def _figures(found: "Verification", wall_s: float) -> dict[str, Any]:
    speed = {"wall_s": round(wall_s, 3), "real_time_factor": round(found.duration_s / wall_s, 1)}
    return {**msgspec.structs.asdict(found), **speed}


def _tell(found: "Verification", wall_s: float) -> None:
    console = Console(width=None if Console().is_terminal else 120, highlight=False)

    def say(text: str, style: str = "") -> None:
        console.print(Text(text, style), soft_wrap=True)

    for note in found.notes:
        say(f"note: {note}", "yellow")
    console.print(_table(found.lives))
    for proof in found.lives:
        for line in _remarks(proof):
            say(f"{_name(proof)}: {line}")
    for problem in found.problems:
        say(problem, "red")
    if found.others:
        names = ", ".join(f"{one.source or '?'} ({one.messages})" for one in found.others)
        say(f"not run again: {names}, and {found.of_hosts} messages of hosts about themselves")
    divergences = [proof.divergence for proof in found.lives if proof.divergence]
    for place, one in enumerate(sorted(divergences, key=lambda one: one.journaled_ns)):
        for line in _divergence(one, with_trace=place == 0):
            say(line)
    say(_verdict(found, wall_s), "bold green" if found.holds else "bold red")


def _table(lives: Iterable["Proof"]) -> Table:
    table = Table("node", "life", "verdict")
    for heading in ("calls", "same bytes", "near", "differ", "unproved", "not recorded"):
        table.add_column(heading, justify="right", no_wrap=True)
    for proof in lives:
        counts = (
            proof.calls,
            proof.messages,
            proof.near,
            proof.differing,
            proof.unproved,
            proof.unrecorded,
        )
        verdict = Text(proof.verdict, _COLOURS[proof.verdict])
        table.add_row(Text(proof.node), str(proof.incarnation), verdict, *map(str, counts))
    return table


def _remarks(proof: "Proof") -> Iterable[str]:
    if proof.reason:
        yield proof.reason
    elif proof.unproved:
        tail = f"its last {proof.unproved_s:.2f} s ({proof.unproved} messages) are unproved"
        yield f"killed, or the recording ends: {tail}"
    elif proof.ended == "cut":
        yield "killed, or the recording ends: its journal has no stop"
    if proof.unrecorded:
        yield f"{proof.unrecorded} of the messages that it sends are not recorded"
    if proof.altered:
        yield f"{proof.altered} messages reached it with bits flipped on the way, and were not refused"


def _divergence(found: "Divergence", with_trace: bool) -> Iterable[str]:
    who = f"{found.node} (life {found.incarnation})"
    yield f"{who} first diverges at call {found.call}, {found.life_s:.6f} s into its life:"
    yield f"  {found.problem}"
    if found.field:
        more = f" (and {found.fields - 1} more values of this message)" if found.fields > 1 else ""
        values = f"recorded {_shown(found.recorded)}, recomputed {_shown(found.recomputed)}"
        yield f"  {found.field}: {values}{more}"
    if not with_trace:
        return
    yield "  the calls up to then:"
    began = found.now_ns - round(found.life_s * 1e9)
    for one in found.trace:
        yield f"  {one.call:>7}  {(one.now_ns - began) / 1e9:>12.6f} s  {_call(one)}"


def _call(one: "Input") -> str:
    if one.kind != "message":
        return f"timer {one.name}" if one.kind == "timer" else one.kind
    text = json.dumps(one.message)
    shown = text if len(text) <= _WIDEST else f"{text[:_WIDEST]}..."
    return f"{one.name} {one.seq} of {one.source} (life {one.incarnation}) {shown}"


def _shown(value: Any) -> str:
    return json.dumps(value)


def _name(proof: "Proof") -> str:
    return f"{proof.node} (life {proof.incarnation})"


def _count(number: int, one: str, more: str) -> str:
    return f"{number} {one if number == 1 else more}"


def _verdict(found: "Verification", wall_s: float) -> str:
    messages = sum(proof.messages for proof in found.lives)
    near = sum(proof.near for proof in found.lives)
    pace = f"{found.duration_s:.1f} s in {wall_s:.1f} s"
    lives = f"{_count(len(found.lives), 'life', 'lives')} of {_count(len(found.nodes), 'node', 'nodes')}"
    how = f"{messages} messages are identical" + f", {near} within the tolerance" * bool(near)
    if found.holds:
        return f"proved: {how}; {lives}, {pace}"
    bad = sum(not proof.holds for proof in found.lives)
    return f"NOT proved{f', {bad} of {lives}' * bool(bad)}: {how}; {pace}"
