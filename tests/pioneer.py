"""The robot of most tests and its laser, as the catalogue has them."""

from maniple.cli.loading import range_finders, robot_models

PIONEER = robot_models()["pioneer-3dx"]

SICK = range_finders()["sick-lms200"]
