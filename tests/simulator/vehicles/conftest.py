"""Vehicles to be tested from outside."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulator.vehicles.peers import Peer, presented, real


@pytest.fixture(params=["presented", "ardurover"])
def peer(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Peer]:
    """Each vehicle there is."""
    with (presented if request.param == "presented" else real)(tmp_path) as found:
        yield found
