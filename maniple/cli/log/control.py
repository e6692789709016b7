"""`maniple log keep`, `pause` and `resume`: what a running recorder is told."""

from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import Connect, Json, Prefix, Timeout, operator_session
from maniple.core.errors import ArgumentError, RunError

if TYPE_CHECKING:
    from maniple.host.recorder_orders import Order

LONGEST_AFTER_S = 86_400.0

Reason = Annotated[
    str, typer.Option("--reason", metavar="TEXT", help="For whoever reads the recording; it stands in it.")
]
After = Annotated[
    float, typer.Option("--after", metavar="SECONDS", help="Go on for so much longer, in time of the run.")
]


def keep(
    after: After = 0.0,
    reason: Reason = "",
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 30.0,
) -> None:
    """Have a recorder that was started with --keep-last write those last seconds to a new file.

    Says which file that is, on the recorder's computer.

    Exit status: 0 if all such recorders did it, 1 if not or if there is none, 2 bad input.
    """
    from maniple.host.recorder_orders import Order

    if not 0.0 <= after <= LONGEST_AFTER_S:
        raise ArgumentError(f"--after {after:g}: must be from 0 to {LONGEST_AFTER_S:g} s")
    _tell(Order("keep", reason, after), connect, prefix, json, timeout)


def pause(
    reason: Reason = "",
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 10.0,
) -> None:
    """Have recorders write nothing until `maniple log resume`. When, and why, stands in the recording.

    Exit status: 0 if all recorders there did it, 1 if not or if there is none, 2 bad input.
    """
    from maniple.host.recorder_orders import Order

    _tell(Order("pause", reason), connect, prefix, json, timeout)


def resume(
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 10.0,
) -> None:
    """Have paused recorders go on.

    Exit status: 0 if all recorders there did it, 1 if not or if there is none, 2 bad input.
    """
    from maniple.host.recorder_orders import Order

    _tell(Order("resume"), connect, prefix, json, timeout)


def _tell(order: "Order", connect: str, prefix: str, as_json: bool, timeout_s: float) -> None:
    from maniple.host.recorder_orders import order_all

    with operator_session(connect, prefix, timeout_s) as session:
        answers = order_all(session, order, timeout_s)
        if not answers:
            there = "recorder" in session.everyone()
            raise RunError(
                f"a recorder is there, but has not answered within {timeout_s:g} s"
                if there
                else "no recorder is there"
            )
    ok = any(answer.ok for answer in answers) and all(answer.ok for answer in answers if answer.meant)
    if as_json:
        found = {"ok": ok, "order": order.what, "recorders": answers, "connect": connect}
        typer.echo(msgspec.json.encode(found).decode())
    else:
        for answer in answers:
            typer.echo(f"{answer.recorder}: {answer.text}")
    raise typer.Exit(0 if ok else 1)
