"""docs/paper.md names only files, tests and commands that exist, and leaves out no equation or figure."""

import ast
import re
import shlex
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer.main

from benchmarks.__main__ import NAMES
from benchmarks.errata import ERRATA
from maniple.cli import node_commands
from maniple.cli.loading import load
from maniple.cli.program import app

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "paper.md"
SUFFIXES = (".py", ".toml", ".md", ".png")


class Quoted(NamedTuple):
    """Something between backticks, and the line it is in."""

    line: int
    text: str


@cache
def quoted() -> tuple[Quoted, ...]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    return tuple(
        Quoted(k, text) for k, line in enumerate(lines, 1) for text in re.findall(r"`([^`]+)`", line)
    )


def is_command(text: str) -> bool:
    return text.startswith(("maniple ", "python -m ", "make "))


def is_path(text: str) -> bool:
    return not is_command(text) and text.partition("::")[0].endswith(SUFFIXES)


def each(chosen: Callable[[str], bool]) -> list[Any]:
    """One parameter for every different text."""
    texts = dict.fromkeys(text for _, text in quoted() if chosen(text))
    return [pytest.param(text, id=text) for text in texts]


@cache
def functions_of(path: Path) -> frozenset[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test")
    )


@pytest.mark.parametrize("text", each(is_path))
def test_files_and_tests_exist(text: str) -> None:
    name, _, test = text.partition("::")
    assert (ROOT / name).is_file(), f"{name} does not exist"
    assert not test or test in functions_of(ROOT / name), f"{name} has no {test}"


@pytest.mark.parametrize("text", each(is_command))
def test_commands_exist(text: str) -> None:
    words = shlex.split(text)
    problem = {"maniple": maniple_problem, "python": python_problem, "make": make_problem}[words[0]](
        words[1:]
    )
    assert problem is None, f"{text}: {problem}"


def maniple_problem(words: list[str]) -> str | None:
    """What the command line would not understand, or a scenario that is not valid."""
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            return f"no command {words[:1]}; there are {', '.join(command.commands)}"
        name, *words = words
        command = command.commands[name]
    if name not in node_commands.COMMANDS:
        options = {option for parameter in command.params for option in parameter.opts}
        if unknown := [word for word in words if word.startswith("--") and word not in options]:
            return f"no options {unknown}"
    for word in words:
        if word.endswith(".toml"):
            load(ROOT / word, [value for flag, value in pairwise(words) if flag == "--set"])
    return None


def python_problem(words: list[str]) -> str | None:
    """A module or a name for it that does not exist."""
    _, module, *rest = words
    if find_spec(module) is None:
        return f"no module {module}"
    names = [word for word in rest if not word.startswith("-")]
    known = {"benchmarks": NAMES, "benchmarks.errata": tuple(ERRATA)}.get(module)
    unknown = [] if known is None else [name for name in names if name not in known]
    return f"{module} has no {unknown}" if unknown else None


def make_problem(words: list[str]) -> str | None:
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    return None if words[0] in targets else f"the Makefile has no {words[0]}"


def test_every_row_has_as_many_cells_as_its_heading() -> None:
    width = 0
    for number, line in enumerate(PAGE.read_text(encoding="utf-8").splitlines(), 1):
        cells = len(re.sub(r"`[^`]*`", "", line).split("|")) if line.startswith("|") else 0
        assert not (width and cells) or cells == width, f"line {number}"
        width = cells


def test_no_equation_figure_or_erratum_is_left_out() -> None:
    page = PAGE.read_text(encoding="utf-8")
    first_cells = re.findall(r"^\| ([^|]*?) \|", page, re.MULTILINE)
    for number in range(1, 15):
        assert f"({number})" in first_cells, f"eq. ({number})"
    for number in range(1, 10):
        assert f"{number}" in first_cells, f"fig. {number}"
    shown = {text.split()[3] for _, text in quoted() if text.startswith("python -m benchmarks.errata ")}
    assert shown == set(ERRATA)


def test_what_does_not_exist_is_found() -> None:
    assert maniple_problem(["fly"]) is not None
    assert maniple_problem(["log", "infos", "x.mcap"]) is not None
    assert (
        maniple_problem(["run", "scenarios/paper-simulation-1.toml", "--virtual", "--sett", "a=1"])
        is not None
    )
    assert (
        maniple_problem(["run", "scenarios/paper-simulation-1.toml", "--set", "controller.angle=unsigned"])
        is None
    )
    assert python_problem(["-m", "benchmarks.nothing"]) is not None
    assert python_problem(["-m", "benchmarks.errata", "sinus"]) is not None
    assert make_problem(["cake"]) is not None
    assert "test_commands_exist" in functions_of(Path(__file__))
    with pytest.raises(AssertionError):
        test_files_and_tests_exist("tests/test_paper.py::test_nothing")
