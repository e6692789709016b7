"""Every benchmark, in its quickest form: it runs, and what it says can be shown."""

import math
import re

import pytest

from benchmarks.__main__ import NAMES, benchmark, machine, main
from benchmarks.common import Budget, Row, best_of, cells, cpu_us, figure, quantile, show

QUICK = ("formation_tick", "range_kernel", "virtual_run")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in NAMES]
)
def test_rows_are_whole(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = benchmark(name)
    rows = chosen.rows(True)
    assert rows
    for row in rows:
        assert math.isfinite(row.ours)
        assert row.ours >= 0
        assert row.reference is None or row.reference > 0
    show(chosen.title, rows)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert len(lines) == len(rows) + 3, "no cell is broken over lines"


@pytest.mark.parametrize(
    ("ours", "reference", "budget", "met"),
    [
        (2.0, 1.0, None, None),
        (2.0, 1.0, Budget(2.0, "ratio"), True),
        (2.0, 1.0, Budget(1.9, "ratio"), False),
        (2.0, None, Budget(1.9, "ratio"), None),
        (2.0, None, Budget(1.9, "ours"), False),
        (2.0, 4.0, Budget(0.5, "ratio", "at least"), True),
        (2.0, 1.0, Budget(3.0, "ours", "at least"), False),
    ],
)
def test_a_budget_is_for_the_figure_or_for_the_ratio(
    ours: float, reference: float | None, budget: Budget | None, met: bool | None
) -> None:
    assert Row("x", ours, "us", "y", reference, budget).met is met


def test_cells() -> None:
    row = Row("x", 1234.5, "us", "y", 0.0123, Budget(250, "ours"))
    assert cells(row) == ("x", "1,234 us", "y", "0.0123 us", "100,366", "<= 250 us", "[red]NO[/]")


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (9.876, "9.88"), (98.76, "98.8"), (98765.0, "98,765")]
)
def test_figure(value: float, text: str) -> None:
    assert figure(value) == text


def test_quantile() -> None:
    assert [quantile(range(101), share) for share in (0, 0.5, 0.99, 1)] == [0, 50, 99, 100]


def test_timing() -> None:
    fast, slow = best_of(lambda: cpu_us(lambda: sum(range(10)), 1e-3), lambda: cpu_us(_slow, 1e-3), rounds=3)
    assert 0 < fast < slow


def _slow() -> int:
    return sum(range(10_000))


def test_an_unknown_name_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["formation_tock"])
    assert "there are virtual_run" in capsys.readouterr().err


def test_chosen_benchmarks_make_one_table(capsys: pytest.CaptureFixture[str]) -> None:
    main(["formation_tick", "--quick"])
    out = capsys.readouterr().out
    assert out.startswith(machine())
    assert re.search(r"\d of 1 budgets met", out)
