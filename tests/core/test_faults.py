import pytest

from maniple.core.faults import matches
from maniple.core.scenario.types import Fault

LINK = ("r1", "controller", "robot/r1/odometry")


@pytest.mark.parametrize(
    ("rule", "applies"),
    [
        (Fault(), True),
        (Fault(source="r1"), True),
        (Fault(source="r[23]"), False),
        (Fault(source="r?", destination="c*"), True),
        (Fault(topic="robot/*/odometry"), True),
        (Fault(topic="robot/*/command"), False),
        (Fault(source="R1"), False),
    ],
)
def test_rules_match_as_file_names_do(rule: Fault, applies: bool) -> None:
    assert matches(rule, *LINK) is applies
