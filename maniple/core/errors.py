"""The exception tree of maniple. A message says what was wrong, where, and what would have been valid."""


class ManipleError(Exception):
    """Base of every error that maniple raises on purpose; its text is meant for the user."""


class ScenarioError(ManipleError):
    """A scenario file or an override is not valid."""


class ArgumentError(ManipleError):
    """An argument of a command or of a function of the interface is not valid."""


class MessageError(ManipleError):
    """Bytes that arrived are not a valid message of their topic."""


class RecordingError(ManipleError):
    """A recording can't be written or read."""


class TransportError(ManipleError):
    """The network can't be reached or opened."""


class RunError(ManipleError):
    """A run could not be started, or ended because one of its processes failed."""


class MissingExtraError(ManipleError):
    """A command needs an optional dependency that is not installed."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs an optional part: pip install 'maniple[{extra}]'")
