import inspect as python
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from maniple.core.scenario import fields, types
from maniple.core.scenario.types import Parameters, Scenario

KINDS = [
    kind
    for _, kind in python.getmembers(types, python.isclass)
    if issubclass(kind, Parameters) and kind is not Parameters
]
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.floats(-3, 3)
    | st.sampled_from(["", "r1", "drive", "circle"]),
    lambda inner: (
        st.lists(inner, max_size=6) | st.dictionaries(st.sampled_from(["kind", "id", "b"]), inner, max_size=2)
    ),
    max_leaves=8,
)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_field_says_what_it_expects(kind: type[Parameters]) -> None:
    info = fields.type_of(kind)
    for field in info.fields:
        text = fields.expected(fields.literals(info, field.name))
        assert text
        assert "inspect" not in text


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None, derandomize=True, max_examples=60)
@given(value=values)
def test_what_has_no_problems_is_decoded_and_nothing_else(kind: type[Parameters], value: Any) -> None:
    """Against msgspec itself: each field of a type, given any value. Ours may refuse more, never less."""
    info = fields.type_of(kind)
    for field in info.fields:
        target = python.get_annotations(kind)[field.name]
        found = list(fields.problems(field.type, value, "x"))
        try:
            msgspec.convert(value, target)
        except msgspec.ValidationError:
            assert found, f"{field.name} = {value!r} can't be decoded"
        else:
            assert not found or _stricter(value), f"{field.name} = {value!r}: {found}"
        assert all(line.startswith("x") for line in found)


def _stricter(value: Any) -> bool:
    """What is refused though msgspec takes it: a table without its `kind`, here or deeper."""
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_stricter, value)))


def test_choices_are_listed_as_declared() -> None:
    info = fields.type_of(types.Placement)
    assert fields.expected(fields.literals(info, "robot_from")) == (
        "one of kinematics, avoidance, compensation, drive"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, "true"), ("a", "'a'"), (1.5, "1.5"), ([1] * 99, repr([1] * 99)[:57] + "...")],
)
def test_values_are_shown_short(value: Any, text: str) -> None:
    assert fields.shown(value) == text


def test_what_no_parameter_is_has_no_description() -> None:
    with pytest.raises(TypeError, match="no parameter is"):
        fields.expected(inspect.DateTimeType(tz=None))


def test_the_whole_scenario_is_described() -> None:
    assert fields.type_of(Scenario).cls is Scenario
