"""The robot of most tests, as the catalogue has it."""

from maniple.cli.loading import robot_models

PIONEER = robot_models()["pioneer-3dx"]
