"""The program `maniple`. Heavy parts are imported by the command that needs them.

All else is imported by `main` too: an interrupt while that takes its time ends the program as any other.
"""

import errno
import os
import sys

_OUTPUT_IS_GONE = (errno.ENOSPC, errno.EPIPE, errno.EBADF)


def main() -> None:
    """Run the command line; a user's mistake ends in one message and status 2, a failed run in status 1, an
    interrupt that no command takes as a request in status 130."""
    try:
        _run()
    except KeyboardInterrupt:
        sys.exit(130)


def _run() -> None:
    from maniple.cli.processes import environment

    environment()  # before anything imports NumPy

    from maniple.cli import node_commands
    from maniple.core.errors import ManipleError, RunError

    try:
        if node_commands.is_one(sys.argv[1:]):
            node_commands.main(sys.argv[1:])
        else:
            from maniple.cli.program import app

            app()
    except ManipleError as error:
        from rich.console import Console

        Console(stderr=True, soft_wrap=True).print(
            f"error: {error}", style="red", highlight=False, markup=False
        )
        sys.exit(1 if isinstance(error, RunError) else 2)
    except OSError as error:
        if error.errno not in _OUTPUT_IS_GONE:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(f"error: can't write to standard output: {error.strerror}")


if __name__ == "__main__":
    main()
