"""A small scenario, as a file would have it."""

from typing import Any

import pytest


@pytest.fixture
def data() -> dict[str, Any]:
    """Three robots that drive three metres; a fresh copy for each test."""
    model = {
        "length_m": 0.5,
        "width_m": 0.4,
        "wheel_radius_m": 0.1,
        "track_m": 0.33,
        "ticks_per_revolution": 1000,
        "u_max_mps": 0.75,
        "w_max_radps": 1.7,
        "u_accel_mps2": 0.3,
        "w_accel_radps2": 1.7,
        "brake_mps2": 0.6,
        "theta": [0.26, 0.25, 0, 1, 0, 1.07],
    }
    finder = {"beams": 181, "first_angle_rad": -1.5707963, "increment_rad": 0.01745329, "range_max_m": 8}
    return {
        "name": "small",
        "task": {"kind": "line", "start": [0, 0], "end": [3, 0], "speed_mps": 0.1},
        "formation": {"points": [[1, 0], [0, 0.8], [0, -0.8]]},
        "robots": [{"id": f"r{k}", "model": "cart", "sensor": "eye"} for k in (1, 2, 3)],
        "models": {"cart": model},
        "sensors": {"eye": finder},
    }
