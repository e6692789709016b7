"""The conformance suite of all drivers, over a real router, with a cable that is cut and somebody who takes
the robot."""

import pytest

from robot_agent.drivers.conformance import check
from robot_agent.drivers.ros2.driver import Ros2Driver
from tests.robot_agent.drivers.ros2.peer import Peer, scene


@pytest.mark.slow
def test_the_driver_keeps_all_that_is_asked_of_drivers() -> None:
    extra = "ros2 = { stamped = true }"
    scenario, robot = scene(extra)
    with Peer(scenario, robot) as peer:
        findings = check(Ros2Driver, scenario, "r2", peer, endpoint=peer.endpoint, patience_s=15.0)
    assert [finding for finding in findings if not finding.holds] == []
