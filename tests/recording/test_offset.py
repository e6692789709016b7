import numpy as np
import pytest

from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.recording.offset import offset_of


def heard(
    seconds: int, ahead_ns: int, drift_ppm: float, jitter_ns: float = 0.0
) -> tuple[list[int], list[int]]:
    """Times of the same events by a clock that is ahead, and by ours; each with its own latency."""
    rng = np.random.default_rng(7)
    ours, theirs = [], []
    for tick in range(20 * seconds):
        now = VIRTUAL_EPOCH + tick * 50 * MILLISECOND
        ours.append(now + round(rng.exponential(jitter_ns)))
        there = now + round(rng.exponential(jitter_ns))
        theirs.append(there + ahead_ns + round(drift_ppm * 1e-6 * (there - VIRTUAL_EPOCH)))
    return theirs, ours


@pytest.mark.parametrize("ahead_ns", [0, 3 * SECOND + 7, -(10**17)])
def test_an_offset_alone_is_exact(ahead_ns: int) -> None:
    theirs, ours = heard(5, ahead_ns, 0.0)
    found = offset_of(theirs, ours)
    assert (found.ahead_ns, found.drift_ppm, found.spread_ns, found.common) == (ahead_ns, 0.0, 0, 100)
    assert [found.right(time) for time in theirs] == ours


def test_latencies_cancel_and_drift_is_found() -> None:
    theirs, ours = heard(200, SECOND, 80.0, jitter_ns=2e6)
    found = offset_of(theirs, ours)
    assert found.drift_ppm == pytest.approx(80.0, abs=2.0)
    errors = [abs(found.right(there) - here) for there, here in zip(theirs, ours, strict=True)]
    assert np.median(errors) < 2 * MILLISECOND
    assert max(np.mean(np.reshape([found.right(t) for t in theirs], (10, -1)), 1)
               - np.mean(np.reshape(ours, (10, -1)), 1)) < 0.5 * MILLISECOND  # fmt: skip
    assert found.spread_ns < 10 * MILLISECOND


def test_few_seconds_tell_no_drift() -> None:
    found = offset_of(*heard(30, SECOND, 80.0, jitter_ns=1e5))
    assert found.drift_ppm == 0.0
    assert found.ahead_ns == pytest.approx(SECOND, abs=2 * MILLISECOND)


def test_outliers_do_not_matter() -> None:
    theirs, ours = heard(100, SECOND, 0.0, jitter_ns=1e5)
    theirs[::5] = [time + 3600 * SECOND for time in theirs[::5]]
    assert offset_of(theirs, ours).ahead_ns == pytest.approx(SECOND, abs=MILLISECOND)


def test_one_message_in_common() -> None:
    found = offset_of([500], [200])
    assert (found.ahead_ns, found.common, found.right(600)) == (300, 1, 300)
