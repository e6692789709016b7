"""ArduPilot Rover over MAVLink."""
