"""`maniple bridge ...`: a running platoon for others to see."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import typer

from maniple.cli.interrupt import on_interrupt
from maniple.cli.loading import load
from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import Connect, Timeout, operator_session, require_endpoint
from maniple.cli.scenario_commands import Seed, Set
from maniple.core.errors import MissingExtraError, RunError, TransportError

app = typer.Typer(help="Show a running platoon to other systems.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass


@app.command()
def ros2(
    scenario: Annotated[Path, typer.Argument(help="Scenario file of the platoon that runs.")],
    connect: Connect = LOCAL,
    router: Annotated[
        str | None,
        typer.Option(help="Zenoh router of the ROS 2 side, as tcp/127.0.0.1:7447; else that of --connect."),
    ] = None,
    domain_id: Annotated[
        int, typer.Option("--domain-id", envvar="ROS_DOMAIN_ID", min=0, max=232, help="Of ROS 2.")
    ] = 0,
    namespace: Annotated[str, typer.Option(help="Of the topics; / for none.")] = "/maniple",
    layout: Annotated[
        Literal["rmw_zenoh", "ros2dds"],
        typer.Option(help="How ROS 2 topics are named there: by rmw_zenoh, or by zenoh-bridge-ros2dds."),
    ] = "rmw_zenoh",
    overrides: Set = None,
    seed: Seed = None,
    timeout: Timeout = 10.0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Publish a running platoon in ROS 2, for RViz, rosbag2 and others: poses, scans, frames, the formation.

    It reads only: nothing goes from ROS 2 to the platoon. It runs until it is interrupted. No ROS is needed
    here. A recording is shown by playing it (maniple log play), or as a bag (maniple log export --to
    rosbag2). Needs the extra "ros2". See docs/ros2.md.

    Exit status: 0 when it was asked to end, 1 no router answers, 2 bad input.
    """
    try:
        import rosbags.typesys  # noqa: F401
    except ImportError:
        raise MissingExtraError("maniple bridge ros2", "ros2") from None
    from maniple.host.fate import say
    from maniple.host.ros2_bridge import NODE, Ros2Bridge
    from maniple.recording.ros2 import Names
    from maniple.transport.ros2 import Network, RosSession

    require_endpoint(connect)
    where = router or connect
    require_endpoint(where, "--router")
    resolved = load(scenario, overrides or (), seed)
    names = Names(resolved, namespace)
    network = Network(layout, domain_id)
    try:
        session = RosSession.open(where, NODE, "/", network, timeout)
    except TransportError as error:
        raise RunError(f"the ROS 2 side: {error}" if router else str(error)) from None
    with session as ros, operator_session(connect, resolved.network.prefix, timeout) as fleet:
        bridge = Ros2Bridge(fleet, ros, resolved, names, say)
        domain = f", domain {domain_id}" if layout == "rmw_zenoh" else ""
        say(f"publishes the platoon at {connect} on {where} ({layout}{domain}) under {namespace}")
        with on_interrupt(bridge.stop):
            told = bridge.run()
    found: dict[str, Any] = {
        "connect": connect,
        "router": where,
        "layout": layout,
        "domain_id": domain_id,
        "namespace": namespace,
        **msgspec.structs.asdict(told),
    }
    if json:
        typer.echo(msgspec.json.encode(found).decode())
    else:
        refused = ", ".join(f"{count} {reason}" for reason, count in told.refused.items())
        typer.echo(
            f"{told.told} messages on {len(told.topics)} topics of ROS 2, from {told.heard} of the platoon "
            f"in {told.wall_s:.1f} s{f'; refused: {refused}' if refused else ''}"
        )
