"""The control layers that may run on either side, robot or controller: pure functions and state machines."""
