"""`maniple doctor`."""

from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

_COLOURS = {"ok": "green", "poor": "yellow", "missing": "red"}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Look whether this machine can run a platoon: packages, network, timers, disk.

    Exit status: 0 if it can, 1 if something that is needed is missing.
    """
    from maniple.cli.doctor import checks
    from maniple.core.version import __version__

    found = list(checks())
    able = all(check.state != "missing" for check in found)
    if as_json:
        typer.echo(msgspec.json.encode({"ok": able, "maniple": __version__, "checks": found}))
    else:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for check in found:
            state = Text(check.state, style=_COLOURS[check.state])
            table.add_row(state, Text(check.name), Text(check.found), Text(check.advice, style="dim"))
        console = Console(highlight=False)
        console.print(table)
        console.print("this machine can run a platoon" if able else "this machine can't run a platoon")
    raise typer.Exit(0 if able else 1)
