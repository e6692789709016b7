"""How a process that nobody supervises is ended over the network."""

from collections.abc import Callable

from maniple.transport.zenoh import ZenohSession


def end_when_asked(session: ZenohSession, node: str, end: Callable[[], None]) -> None:
    """Call `end`, which must only take note, when somebody asks this node to."""

    def asked(name: str) -> dict[str, bytes]:
        end()
        return {name: b""}

    session.serve(_name(node), asked)


def ask_to_end(session: ZenohSession, node: str, timeout_s: float = 2.0) -> bool:
    """Ask a node to end; whether it said that it will."""
    return bool(session.ask(_name(node), timeout_s))


def _name(node: str) -> str:
    return f"end/{node}"
