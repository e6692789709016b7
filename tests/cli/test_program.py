"""Tests of `maniple.cli.program`: what all commands have in common."""

from collections.abc import Iterator
from typing import Any

import pytest
import typer
from rich.text import Text

from maniple.cli.program import app


def commands(group: Any, name: str = "maniple") -> Iterator[tuple[str, Any]]:
    yield name, group
    for child, command in getattr(group, "commands", {}).items():
        yield from commands(command, f"{name} {child}")


@pytest.mark.parametrize(("name", "command"), list(commands(typer.main.get_command(app))))
def test_nothing_in_a_help_text_is_lost_as_markup(name: str, command: Any) -> None:
    texts = [command.help or "", *(getattr(param, "help", None) or "" for param in command.params)]
    assert [Text.from_markup(text).plain for text in texts] == texts, name
