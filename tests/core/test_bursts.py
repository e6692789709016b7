"""The Gilbert-Elliott chain at any message, against a walk from the first one and against its closed form."""

import hashlib
import math
import struct
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from maniple.core.bursts import BurstChain, Draw
from maniple.core.scenario.types import Burst

COUNT = 40_000
CHAINS = [(0.01, 0.2), (0.3, 0.5), (0.5, 0.5), (0.8, 0.7), (1.0, 0.25), (0.002, 0.01)]


def draws(seed: int) -> Draw:
    def draw(life: int, block: int, count: int) -> tuple[float, float]:
        digest = hashlib.blake2b(struct.pack("<4q", seed, life, block, count), digest_size=16).digest()
        gap, state = struct.unpack("<2Q", digest)
        return gap * 2.0**-64, state * 2.0**-64

    return draw


@cache
def states(enter: float, leave: float, seed: int = 1, count: int = COUNT) -> NDArray[np.bool_]:
    chain = BurstChain(Burst(enter=enter, leave=leave), draws(seed))
    return np.array([chain.is_bad(1, seq) for seq in range(count)])


def walked(enter: float, leave: float, draw: Draw, count: int) -> list[bool]:
    """The same chain step by step: stay or swap, and now and then a fresh draw."""
    fresh = 1.0 - abs(1.0 - enter - leave)
    swaps = enter + leave > 1.0
    share = enter / (enter + leave)
    block = math.ceil(1.0 / fresh)
    bad = draw(1, -1, 0)[1] < share
    found: list[bool] = []
    for seq in range(count):
        if seq % block == 0:
            number, wait = 0, skipped(draw(1, seq // block, 0)[0], fresh)
        bad = bad != swaps
        if wait == 0:
            bad = draw(1, seq // block, number)[1] < ((1.0 - leave) / fresh if swaps else share)
            number += 1
            wait = skipped(draw(1, seq // block, number)[0], fresh)
        else:
            wait -= 1
        found.append(bad)
    return found


def skipped(uniform: float, chance: float) -> int:
    """Failures before the first success: geometric, by inversion."""
    return 0 if chance == 1.0 else math.floor(math.log(1.0 - uniform) / math.log(1.0 - chance))


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.floats(0.0, 1.0), st.floats(0.02, 1.0), st.integers(0, 1000))
def test_any_message_is_as_walked_to_from_the_first(enter: float, leave: float, seed: int) -> None:
    assume(abs(1.0 - enter - leave) < 1.0)
    assert states(enter, leave, seed, 300).tolist() == walked(enter, leave, draws(seed), 300)


@pytest.mark.parametrize(("enter", "leave"), CHAINS)
def test_it_steps_as_the_chain_does(enter: float, leave: float) -> None:
    """Both rows of the transition matrix, by the normal bound of a binomial count."""
    bad = states(enter, leave)
    before, after = bad[:-1], bad[1:]
    for state, chance in ((False, enter), (True, 1.0 - leave)):
        tried = int((before == state).sum())
        got = int(after[before == state].sum())
        assert abs(got - tried * chance) <= 4.5 * math.sqrt(tried * chance * (1.0 - chance)) + 1e-9


@pytest.mark.parametrize(("enter", "leave"), CHAINS)
def test_it_is_stationary_from_the_first_message(enter: float, leave: float) -> None:
    chain = BurstChain(Burst(enter=enter, leave=leave), draws(1))
    share = enter / (enter + leave)
    for seq in (0, 1, 7):
        bad = sum(chain.is_bad(life, seq) for life in range(4000))
        assert abs(bad - 4000 * share) <= 4.5 * math.sqrt(4000 * share * (1.0 - share))


@pytest.mark.parametrize(("enter", "leave"), [(0.05, 0.25), (0.3, 0.5), (0.9, 0.6)])
def test_bursts_and_gaps_are_geometric(enter: float, leave: float) -> None:
    bad = states(enter, leave)
    edges = np.flatnonzero(np.diff(bad)) + 1
    lengths, kinds = np.diff(edges), bad[edges[:-1]]
    for state, chance in ((True, leave), (False, enter)):
        found = lengths[kinds == state]
        bins = np.arange(1, 8)
        counts = np.array([*((found == k).sum() for k in bins), (found > bins[-1]).sum()])
        chances = np.array([*(chance * (1.0 - chance) ** (bins - 1)), (1.0 - chance) ** bins[-1]])
        hoped = len(found) * chances
        kept = hoped >= 5.0
        statistic = float((((counts - hoped) ** 2) / np.maximum(hoped, 1e-9))[kept].sum())
        assert statistic < 27.9  # the 0.05 % point of chi square with 8 degrees of freedom


def test_a_chain_that_swaps_at_every_message_has_no_end_to_walk_to() -> None:
    found = states(1.0, 1.0, count=100)
    assert (found[1:] != found[:-1]).all()


def test_it_costs_the_same_wherever_one_asks() -> None:
    asked: list[int] = []

    def counting(life: int, block: int, count: int) -> tuple[float, float]:
        asked.append(block)
        return draws(5)(life, block, count)

    chain = BurstChain(Burst(enter=1e-9, leave=1e-9), counting)
    for seq in (0, 10**6, 2**61, 2**62 - 1):
        asked.clear()
        chain.is_bad(1, seq)
        assert len(asked) < 20


def test_where_one_asked_before_does_not_matter() -> None:
    burst = Burst(enter=0.05, leave=0.1)
    chain = BurstChain(burst, draws(1))
    asked = [(life, seq) for seq in range(300) for life in (1, 2)]
    found = {key: chain.is_bad(*key) for key in asked}
    again = BurstChain(burst, draws(1))
    assert {key: again.is_bad(*key) for key in sorted(asked, reverse=True)} == found


@pytest.mark.parametrize("enter", [0.0, 5e-324, 1e-300])
def test_numbers_at_the_edge_are_chains_too(enter: float) -> None:
    assert not BurstChain(Burst(enter=enter, leave=1.0), draws(1)).is_bad(1, 2**61)
    chain = BurstChain(Burst(enter=enter, leave=5e-324), draws(1))
    assert chain.is_bad(1, 0) == chain.is_bad(1, 2**61)
