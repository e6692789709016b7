"""The commands of `maniple` for people; those of `node_commands` are listed and passed on."""

import typer

from maniple.cli import (
    bridge_command,
    doctor_command,
    driver_command,
    fault_command,
    goal_command,
    layer_commands,
    node_commands,
    plan_command,
    preflight_command,
    report_command,
    run_command,
    scenario_commands,
    status_command,
    stop_command,
    sweep_command,
)
from maniple.cli.log import group
from maniple.core.version import __version__

app = typer.Typer(
    name="maniple",
    help="Guide mobile robots in formation over a network that fails, and prove afterwards what happened.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _pass_on(context: typer.Context) -> None:
    node_commands.main([context.info_name or "", *context.args])


app.command("run")(run_command.run)
app.command("plan")(plan_command.show)
app.command("preflight")(preflight_command.preflight)
app.command("status")(status_command.status)
app.command("stop")(stop_command.stop)
app.command("arm")(stop_command.arm)
app.command("doctor")(doctor_command.doctor)
app.command("report")(report_command.report)
app.command("sweep")(sweep_command.sweep)
for _name, _about in node_commands.COMMANDS.items():
    app.command(
        _name,
        help=_about,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )(_pass_on)
app.add_typer(bridge_command.app, name="bridge")
app.add_typer(driver_command.app, name="driver")
app.add_typer(fault_command.app, name="fault")
app.add_typer(goal_command.app, name="goal")
app.add_typer(layer_commands.app, name="layer")
app.add_typer(group.app, name="log")
app.add_typer(scenario_commands.app, name="scenario")


def _version(asked: bool) -> None:
    if asked:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Show the version."
    ),
) -> None:
    pass
