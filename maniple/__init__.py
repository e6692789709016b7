"""Formation control of mobile robots by triangular modules, over a network that fails.

`maniple.run(scenario, ...)` does from Python what `maniple run` does on the command line.
"""

from typing import TYPE_CHECKING, Any

from maniple.core.version import __version__

if TYPE_CHECKING:
    from maniple.cli.api import Result, run

__all__ = ["Result", "__version__", "run"]


def __getattr__(name: str) -> Any:
    """Import the Python interface on first use, so that a node process does not pay for it."""
    if name in ("run", "Result"):
        from maniple.cli import api

        return getattr(api, name)
    raise AttributeError(f"module 'maniple' has no attribute {name!r}")
