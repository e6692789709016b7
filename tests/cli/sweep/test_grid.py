import itertools
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maniple.cli.sweep.grid import Combination, axes_of, combinations, read_sweep, seeds_of, toml_text
from maniple.core.errors import ScenarioError
from maniple.core.scenario.parse import with_overrides
from tests.cli.sweep.files import GRID, write_sweep

BASE: dict[str, Any] = {
    "name": "base",
    "robots": [{"id": "r1", "model": "robotino", "pose": [0, 0, 0]}, {"id": "r2"}, {"id": "r3"}],
    "faults": [{"loss": 0.1}, {"latency_s": 0.2}],
}


def expand(text: str) -> list[Combination]:
    return list(combinations(axes_of(tomllib.loads(text)), BASE))


def scenarios(text: str) -> list[dict[str, Any]]:
    """What the combinations make of the base."""
    return [with_overrides(BASE, each.overrides) for each in expand(text)]


def test_the_grid_is_the_product_of_its_axes() -> None:
    kappa, loss, layer = [0.1, 0.2, 0.3], [0.0, 0.5], ["drive", "kinematics"]
    found = expand(f"controller.kappa = {kappa}\nfaults.0.loss = {loss}\nplacement.robot_from = {layer}")
    assert [each.values for each in found] == list(itertools.product(kappa, loss, layer))
    for each in found:
        table = with_overrides(BASE, each.overrides)
        assert table["controller"]["kappa"] == each.values[0]
        assert table["faults"] == [{"loss": each.values[1]}, {"latency_s": 0.2}]
        assert table["placement"]["robot_from"] == each.values[2]


def test_quoted_keys_and_tables_are_the_same() -> None:
    assert expand('"faults.0.loss" = [0.1, 0.2]') == expand("faults.0.loss = [0.1, 0.2]")
    assert expand("[faults.0]\nloss = [0.1, 0.2]") == expand("faults.0.loss = [0.1, 0.2]")


def test_linked_fields_have_the_same_value() -> None:
    text = "both = { keys = ['faults.0.latency_s', 'faults.1.latency_s'], values = [0.3, 0.4] }"
    assert [each.values for each in expand(text)] == [(0.3,), (0.4,)]
    for table, value in zip(scenarios(text), (0.3, 0.4), strict=True):
        assert [fault["latency_s"] for fault in table["faults"]] == [value, value]


def test_points_have_labels_and_change_several_fields() -> None:
    text = """
    [net.points]
    good = []
    bad = ["faults.0.loss=0.6", "guard.clearance=false", "name=worse"]
    """
    good, bad = scenarios(text)
    assert good == BASE
    assert (bad["faults"][0], bad["guard"], bad["name"]) == ({"loss": 0.6}, {"clearance": False}, "worse")
    assert [each.values for each in expand(text)] == [("good",), ("bad",)]


def test_a_number_of_robots_stands_for_that_many_like_the_first() -> None:
    three, five = scenarios("robots = [3, 5]")
    assert [robot["id"] for robot in five["robots"]] == ["r1", "r2", "r3", "r4", "r5"]
    assert three["robots"] == five["robots"][:3]
    assert all(robot == {"id": robot["id"], "model": "robotino"} for robot in five["robots"])


def test_a_star_is_every_entry_that_is_there_then() -> None:
    for table in scenarios("robots = [3, 4]\na = { keys = ['robots.*.control_point_m'], values = [0.1] }"):
        assert [robot["control_point_m"] for robot in table["robots"]] == [0.1] * len(table["robots"])


def test_lists_and_tables_are_values_too() -> None:
    text = "faults = [[], [{ loss = 0.3, topic = 'a' }]]"
    assert [table["faults"] for table in scenarios(text)] == [[], [{"loss": 0.3, "topic": "a"}]]
    assert expand(text)[0].values == ("[]",)


VALUES = st.recursive(
    st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs", "Cc"])),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text("abc.*é", min_size=1), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(VALUES)
def test_a_value_written_as_toml_is_the_same_again(value: Any) -> None:
    assert tomllib.loads(f"value = {toml_text(value)}")["value"] == value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("seeds = [5, 3]", "seeds = 0"), "seeds = 0: must be a whole number >= 1, or a list of seeds"),
        (("seeds = [5, 3]", "seeds = 2.5"), "seeds = 2.5: must be a whole number"),
        (("seeds = [5, 3]", "seeds = []"), "seeds = []: must be at least one, each once"),
        (("seeds = [5, 3]", "seeds = [1, 1]"), "seeds = [1, 1]: must be at least one, each once"),
        (("seeds = [5, 3]", "seeds = [-1]"), "seeds[0] = -1: must be a whole number >= 0"),
        (("seeds = [5, 3]", "sedes = 3"), "sedes: unknown field; valid: name,"),
        (("duration_s = 4", "duration_s = 0"), "duration_s = 0: must be a finite number > 0"),
        (
            ('["drive", "kinematics"]', '"drive"'),
            "grid.placement.robot_from = 'drive': must be a list of values",
        ),
        (
            ('["drive", "kinematics"]', "[]"),
            "grid.placement.robot_from: must have at least one value, each once",
        ),
        (("[0.0, 0.4]", "[0.4, 0.4]"), "grid.loss: must have at least one value, each once"),
        (("keys =", "key ="), "grid.loss = "),
        (("loss = {", "placement.robot_from.x = {"), "TOML"),
        (("[grid]", "[grid.placement.points]\nx = ['a']\n[grid]"), "must have points and nothing else"),
        (
            ("[[plots]]", "[grid.p.points]\nx = ['guard']\n[[plots]]"),
            "grid.p.points.x: 'guard': must be KEY=VALUE",
        ),
        (
            ("[[plots]]", "[grid.p.points]\nx = 3\n[[plots]]"),
            'grid.p.points.x = 3: must be ["KEY=VALUE", ...]',
        ),
        (('x = "loss"', "z = 1"), "plots[0].z: unknown field"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert change[0] in GRID
    path = write_sweep(tmp_path, GRID.replace(*change))
    with pytest.raises(ScenarioError) as raised:
        read_sweep(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)


def test_a_number_of_seeds_counts_from_one(tmp_path: Path) -> None:
    assert seeds_of(read_sweep(write_sweep(tmp_path))) == (5, 3)
    again = write_sweep(tmp_path, GRID.replace("[5, 3]", "20"))
    assert seeds_of(read_sweep(again)) == tuple(range(1, 21))


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(ScenarioError, match="grid: is empty"):
        axes_of({})


def test_a_star_needs_entries() -> None:
    with pytest.raises(
        ScenarioError, match=r"world\.obstacles\.\*\.radius_m: world\.obstacles has no entries"
    ):
        expand("r = { keys = ['world.obstacles.*.radius_m'], values = [1.0] }")
