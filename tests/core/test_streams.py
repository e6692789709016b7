import numpy as np
import pytest

from maniple.core.streams import stream


def test_a_stream_is_a_function_of_seed_and_name() -> None:
    assert stream(3, "scan/r1").random(8).tolist() == stream(3, "scan/r1").random(8).tolist()


def test_streams_differ_by_seed_and_by_name() -> None:
    names = ["scan/r1", "scan/r2", "scan/r11", "scan", ""]
    first = {stream(seed, name).random() for seed in (0, 1, 2**53) for name in names}
    assert len(first) == 3 * len(names)


def test_streams_are_not_correlated() -> None:
    samples = np.array([stream(1, f"scan/r{k}").standard_normal(20_000) for k in range(6)])
    off_diagonal = np.corrcoef(samples)[~np.eye(6, dtype=bool)]
    assert np.abs(off_diagonal).max() < 0.03


def test_streams_stay_what_they_were() -> None:
    """Recordings of older versions can only be made again while these numbers stand."""
    assert stream(1, "start/r1").random(2) == pytest.approx(
        [0.8958876351211912, 0.7751124371603949], rel=1e-15
    )
