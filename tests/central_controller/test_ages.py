"""Ages by round trips, against a network of which the test knows when everything was really sent."""

import random
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from central_controller.ages import RobotClock
from maniple.core.clocks import NodeClock
from maniple.core.messages import Odometry, Stamp
from maniple.core.time import MILLISECOND, SECOND, Time, from_seconds, to_seconds

T0 = 1000 * SECOND


class Way(NamedTuple):
    """The network, one way."""

    latency_s: float
    jitter_s: float = 0.0
    loss: float = 0.0

    def arrival(self, sent: Time, source: random.Random) -> Time | None:
        if source.random() < self.loss:
            return None
        return sent + from_seconds(self.latency_s + source.uniform(0.0, self.jitter_s))


def talk(
    up: Way, down: Way, own: NodeClock, seconds: float, cut_s: tuple[float, float] = (0.0, 0.0), seed: int = 1
) -> tuple[RobotClock, list[tuple[Time, Time, float]]]:
    """Odometry at 20 Hz, commands at 10 Hz that are acted on at 20 Hz, by a robot whose clock is `own`. What
    would arrive between `cut_s` does when that is over. The controller's view at every odometry: when it
    arrived, when it was sent, and how old it took it for, s."""
    source = random.Random(seed)
    clock = RobotClock(incarnation=2)
    cut = tuple(T0 + from_seconds(at) for at in cut_s)
    heard: list[tuple[Time, int, Odometry, Time]] = []
    orders: list[tuple[Time, Time]] = []
    applied: tuple[Time, Time] | None = None

    def through(way: Way, sent: Time) -> Time | None:
        arrival = way.arrival(sent, source)
        return max(arrival, cut[1]) if arrival is not None and cut[0] <= arrival < cut[1] else arrival

    for k in range(round(seconds * 20)):
        now = T0 + k * 50 * MILLISECOND
        if k % 2 == 0 and (arrival := through(down, now)) is not None:
            orders.append((arrival, now))
        taken = [order for order in orders if order[0] <= now]
        applied = max(taken, key=lambda order: order[1], default=applied)
        orders = [order for order in orders if order[0] > now or order == applied]
        said = Odometry(
            seq=k,
            stamp_ns=own.shown(now),
            frame_id="r1",
            x_m=0.0,
            y_m=0.0,
            psi_rad=0.0,
            u_mps=0.0,
            w_radps=0.0,
            applied=None if applied is None else Stamp(2, 0, applied[1]),
            held_ns=0 if applied is None else own.shown(now) - own.shown(applied[0]),
        )
        if (arrival := through(up, now)) is not None:
            heard.append((arrival, k, said, now))
    out, newest = [], -1
    for arrival, seq, said, sent in sorted(heard, key=lambda one: one[:2]):
        if seq > newest:
            newest = seq
            clock.heard(said, arrival)
            out.append((arrival, sent, to_seconds(clock.age(said.stamp_ns, arrival))))
    return clock, out


def errors(heard: list[tuple[Time, Time, float]], after_s: float) -> list[float]:
    """Taken minus true age, s, from `after_s` on."""
    late = [one for one in heard if one[0] >= T0 + from_seconds(after_s)]
    return [age - to_seconds(arrival - sent) for arrival, sent, age in late]


clocks = st.builds(
    NodeClock,
    st.just(T0),
    st.floats(-1e5, 1e5).map(from_seconds),
    st.floats(-1000.0, 1000.0),
)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(clocks, st.floats(0.0, 2.0), st.floats(0.0, 0.5), st.floats(0.0, 0.6), st.integers(0, 9))
def test_ages_are_right_whatever_the_clocks_show(
    own: NodeClock, latency_s: float, jitter_s: float, loss: float, seed: int
) -> None:
    way = Way(latency_s, jitter_s, loss)
    _, heard = talk(way, way, own, 40.0, seed=seed)
    off = errors(heard, 15.0)
    assert len(off) > 50
    assert max(map(abs, off)) <= 0.6 * jitter_s + 0.01


def test_without_offset_jitter_and_drift_they_are_exact() -> None:
    way = Way(0.123)
    clock, heard = talk(way, way, NodeClock(T0, from_seconds(-77.7), 0.0), 5.0)
    assert max(map(abs, errors(heard, 1.0))) < 1e-6
    assert clock.round_trip == pytest.approx(0.246 * SECOND)


def test_a_burst_after_a_long_silence_is_as_old_as_it_is() -> None:
    way = Way(0.05, 0.02)
    _, heard = talk(way, way, NodeClock(T0, from_seconds(1e5), 1000.0), 100.0, cut_s=(20.0, 80.0))
    burst = [(arrival, sent, age) for arrival, sent, age in heard if arrival == T0 + 80 * SECOND]
    assert len(burst) > 1000
    assert max(to_seconds(arrival - sent) for arrival, sent, _ in burst) > 59.0
    assert max(map(abs, errors(burst, 0.0))) < 0.15
    assert max(map(abs, errors(heard, 81.0))) < 0.03


def test_a_clock_that_drifts_ten_times_as_fast_is_seen_to_by_round_trips() -> None:
    """Nothing is taken for older than its round trip: twice what it is."""
    for skew in (10_000.0, -10_000.0):
        way = Way(0.05)
        _, heard = talk(way, way, NodeClock(T0, 0, skew), 120.0)
        assert max(map(abs, errors(heard, 5.0))) < 0.055


def test_a_slower_network_is_noticed_at_once() -> None:
    quick, slow = Way(0.01), Way(1.5)
    clock, _ = talk(quick, quick, NodeClock(T0, from_seconds(5.0), 100.0), 10.0)
    own = NodeClock(T0, from_seconds(5.0), 100.0)
    sent = T0 + 11 * SECOND
    arrival = slow.arrival(sent, random.Random(1))
    assert arrival is not None
    late = Odometry(
        stamp_ns=own.shown(sent), frame_id="r1", x_m=0.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0
    )
    clock.heard(late, arrival)
    assert to_seconds(clock.age(late.stamp_ns, arrival)) == pytest.approx(1.5, abs=0.01)


def test_what_comes_back_of_a_former_life_or_from_the_future_measures_nothing() -> None:
    clock = RobotClock(incarnation=2)
    for applied in (Stamp(1, 0, T0), Stamp(2, 0, T0 + 9 * SECOND), None):
        said = Odometry(
            stamp_ns=5, frame_id="r1", x_m=0.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0, applied=applied
        )
        clock.heard(said, T0 + SECOND)
    assert clock.round_trip is None
    assert clock.age(5, T0 + 3 * SECOND) == 2 * SECOND
