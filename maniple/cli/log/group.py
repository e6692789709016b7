"""`maniple log ...`: what can be done with recordings."""

import typer

from maniple.cli.log.control import keep, pause, resume
from maniple.cli.log.cut import cut
from maniple.cli.log.diff import diff
from maniple.cli.log.export import export
from maniple.cli.log.info import info
from maniple.cli.log.merge import merge
from maniple.cli.log.play import play, player
from maniple.cli.log.recover import recover
from maniple.cli.log.rerun import rerun
from maniple.cli.log.verify import verify

app = typer.Typer(help="Work with recordings.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass


app.command()(info)
app.command()(play)
app.command()(player)
app.command()(verify)
app.command()(rerun)
app.command()(diff)
app.command()(export)
app.command()(cut)
app.command()(merge)
app.command()(recover)
app.command()(keep)
app.command()(pause)
app.command()(resume)
