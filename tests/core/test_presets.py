from pathlib import Path

import numpy as np
import pytest

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats
from maniple.core.links import Link
from maniple.core.messages import FaultPlan
from maniple.core.presets import FIELDS, PRESETS, with_preset
from maniple.core.scenario.types import Burst, Fault

DOCS = Path(__file__).parents[2] / "docs" / "faults.md"


def row(name: str, rule: Fault) -> str:
    """A preset as the documentation has it."""
    burst = f"{100 * rule.burst.enter:g}, {100 * rule.burst.leave:g}" if rule.burst else ""
    held = f"{100 * rule.reorder:g} % by {1000 * rule.reorder_s:g} ms" if rule.reorder else ""
    cells = (
        f"`{name}`",
        f"{1000 * rule.latency_s:g} +- {1000 * rule.jitter_s:g}",
        f"{100 * rule.loss:g}" if rule.loss else "",
        burst,
        held,
        f"{rule.rate_kbps:g}" if rule.rate_kbps else "",
    )
    return f"| {' | '.join(cells)} |"


@pytest.mark.parametrize("name", PRESETS)
def test_the_documentation_has_the_numbers_and_a_source(name: str) -> None:
    text = DOCS.read_text()
    assert row(name, PRESETS[name]) in text
    assert f"\n- `{name}`" in text or f", `{name}`: " in text


def test_a_preset_gives_what_is_left_out_once() -> None:
    rule = Fault(source="r1", preset="lte", latency_s=0.5, windows=((1.0, 2.0),))
    filled = with_preset(rule)
    assert (filled.source, filled.preset, filled.windows, filled.latency_s) == (
        "r1",
        "lte",
        ((1.0, 2.0),),
        0.5,
    )
    assert filled.burst == Burst(enter=0.0005, leave=0.1)
    assert with_preset(filled) == filled
    assert with_preset(Fault(loss=0.1)) == Fault(loss=0.1)


def test_every_number_of_a_rule_can_be_a_presets() -> None:
    chosen = {"source", "destination", "topic", "preset", "windows"}
    assert set(FIELDS) == set(Fault.__struct_fields__) - chosen


def test_there_is_no_such_preset() -> None:
    with pytest.raises(ScenarioError, match="preset = 'dsl': must be one of wifi-good, wifi-crowded, lte"):
        with_preset(Fault(preset="dsl"))


def round_trips(name: str) -> Floats:
    """Of 20 000 messages there and back, ms."""
    plan = FaultPlan(since_ns=0, faults=(PRESETS[name],))
    ways = (Link(plan, 1, *ends, "formation/state") for ends in (("a", "b"), ("b", "a")))
    there, back = ([way.decide(1, seq, seq * 10**9, 100).delay for seq in range(20_000)] for way in ways)
    return np.add(there, back) * 1e-6


@pytest.mark.parametrize(
    ("name", "share", "measured_ms", "off_ms"),
    [
        ("wifi-good", 0.5, 3.0, 0.5),
        ("wifi-crowded", 0.5, 20.0, 3.0),
        ("satellite-leo", 0.25, 40.0, 2.0),
        ("satellite-leo", 0.5, 50.0, 1.0),
        ("satellite-leo", 0.75, 60.0, 2.0),
        ("satellite-geo", 0.5, 600.0, 1.0),
    ],
)
def test_round_trips_are_as_measured(name: str, share: float, measured_ms: float, off_ms: float) -> None:
    assert np.quantile(round_trips(name), share) == pytest.approx(measured_ms, abs=off_ms)


def test_tails_are_as_measured() -> None:
    assert np.quantile(round_trips("wifi-good"), 0.9) == pytest.approx(20.0, abs=2.0)
    assert np.mean(round_trips("wifi-crowded") > 20.0) > 0.5
    assert np.mean(round_trips("wifi-crowded") > 100.0) == pytest.approx(0.1, abs=0.015)
    assert round_trips("satellite-leo").min() >= 20.0
