import re

import msgspec
import pytest
from rosbags.typesys import Stores, get_typestore

from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.types import Robot, Scenario
from maniple.recording.ros2 import Names
from tests.cli.scenes import platoon

TYPES = get_typestore(Stores.ROS2_JAZZY)
TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def named(*robots: str) -> Scenario:
    scenario = platoon(len(robots))
    return msgspec.structs.replace(scenario, robots=tuple(Robot(id=robot) for robot in robots))


def test_names_and_types_are_those_of_ros2() -> None:
    topics = [*Names(named("r1", "2nd", "left-wing"))]
    assert len({topic.name for topic in topics}) == len(topics)
    assert all(TOPIC.fullmatch(topic.name) and "__" not in topic.name for topic in topics)
    assert all(topic.type in TYPES.types for topic in topics)
    assert {"/tf", "/tf_static", "/rosout", "/diagnostics", "/maniple/r1/odom", "/maniple/r2nd/scan"} <= {
        topic.name for topic in topics
    }


@pytest.mark.parametrize(
    ("namespace", "name"),
    [
        ("/", "/r1/odom"),
        ("", "/r1/odom"),
        ("/a/b_2", "/a/b_2/r1/odom"),
        ("fleet", "/fleet/r1/odom"),
    ],
)
def test_a_namespace(namespace: str, name: str) -> None:
    assert Names(named("r1", "r2", "r3"), namespace).odometry["r1"].name == name


@pytest.mark.parametrize("namespace", ["/1st", "a b", "/a//b", "/a__b", "//", "/ü", "/a-b", "/a/", "~"])
def test_what_is_no_namespace_is_refused(namespace: str) -> None:
    with pytest.raises(ArgumentError, match="must be one of ROS 2"):
        Names(named("r1", "r2", "r3"), namespace)


def test_two_robots_of_one_name_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"'a-b' and 'a_b'.*would be 'a_b' there"):
        Names(named("a-b", "c", "a_b"))


def test_frames() -> None:
    names = Names(named("r1", "r-2", "r3"))
    assert [names.frame(one) for one in ("world", "r1", "r-2/true")] == [
        "world",
        "r1/base_link",
        "r_2/base_link_true",
    ]
