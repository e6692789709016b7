"""The simulator as a driver. It is a node on the hardware network, so nothing has to run beside the agent.

Its drive is connected and configured from the start ("configured" in `Motion.state`), becomes active with
the first `Drive` that wants it so, and goes back to configured, braking, with one that does not. In silence
it brakes after the model's `drive_timeout_s` and stays active. Its encoders count from the start of the run,
and the robot's odometry frame is its own: where it stood when its agent heard them first.
"""

from maniple.core.scenario.types import Robot, Scenario
from robot_agent.drivers.interface import Capabilities


def capabilities(scenario: Scenario, robot: Robot) -> Capabilities:
    """What the simulated drive and range finder of a robot can do."""
    model = scenario.model_of(robot)
    return Capabilities(
        u_max_mps=model.u_max_mps,
        w_max_radps=model.w_max_radps,
        reverse=True,
        accepts_yaw_rate=True,
        motion_hz=scenario.rates.motion_hz,
        scan_hz=scenario.rates.scan_hz,
        frame=robot.id,
        v_max_mps=model.v_max_mps or 0.0,
    )
