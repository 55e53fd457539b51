"""Rates under a clock of the test's own, and what follows from them."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.bench import roofline
from delo_jax.bench.roofline import Machine, best, free_bytes, measure_machine, too_much
from delo_jax.bench.rows import Group, TooMuch
from delo_jax.bench.timing import UNKNOWN, Cost, Effort

MACHINE = Machine(bandwidth=1e9, gemm=1e11)


def test_rates_are_amounts_over_time(monkeypatch):
    """Oracle: closed form; a trial lasts a second by the clock: 3 arrays of four bytes an entry, 2 n^3 operations."""
    monkeypatch.setattr(roofline, "NUM_FLOATS", 256)
    monkeypatch.setattr(roofline, "GEMM_SIZE", 8)
    seconds = iter(range(100))
    machine = measure_machine(repeats=2, clock=lambda: float(next(seconds)))
    assert machine == Machine(bandwidth=3 * 4 * 256, gemm=2 * 8**3)


@pytest.mark.parametrize(
    ("cost", "least_s"),
    [
        (Cost(2e11, 1e9, 0.0), 2.0),
        (Cost(1e11, 5e9, 0.0), 5.0),
        (Cost(UNKNOWN, 5e9, 0.0), 5.0),
        (Cost(3e11, UNKNOWN, 0.0), 3.0),
        (Cost(UNKNOWN, UNKNOWN, 0.0), UNKNOWN),
    ],
)
def test_the_gap_is_to_the_slower_of_two_bounds(cost, least_s):
    """Oracle: by hand."""
    np.testing.assert_equal(MACHINE.least_s(cost), least_s)
    np.testing.assert_allclose(MACHINE.gap(10_000.0, cost), 10.0 / least_s)


def test_the_better_of_two_measurements():
    """Oracle: by hand; each rate is the higher one."""
    assert best(Machine(1.0, 9.0), Machine(2.0, 8.0)) == Machine(2.0, 9.0)


@pytest.mark.parametrize(
    ("cost", "words"),
    [
        (Cost(1e11, 1e9, 5.9e9), ""),
        (Cost(1e11, 1e9, 6.1e9), "needs 6.1 GB, 10.0 GB are free"),
        (Cost(7e11, 1e9, 1e9), "about 21 s a call"),
        (Cost(UNKNOWN, UNKNOWN, UNKNOWN), ""),
    ],
)
def test_what_is_too_much(cost, words):
    """Oracle: by hand; 60 % of 10 GB, and 20 s at three times the bound."""
    found = too_much(cost, MACHINE, 10e9)
    assert words in found
    assert bool(found) == bool(words)


def test_free_memory_is_part_of_all():
    """Oracle: the operating system's total."""
    assert 0 < free_bytes() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def test_what_is_too_much_is_compiled_and_not_called():
    """Oracle: a function that says when it runs."""
    ran = []

    def function(a):
        jax.debug.callback(lambda: ran.append(1))
        return a @ a

    group, slow = Group("g", Machine(1.0, 1.0), Effort(2, 0.0)), jax.jit(function)
    with pytest.raises(TooMuch, match="product would take about"):
        group.device("product", slow, jnp.ones((8, 8)))
    assert not ran
    assert not group.rows
    Group("g", MACHINE, Effort(2, 0.0, warm_up=0)).device("product", slow, jnp.ones((8, 8)))
    jax.effects_barrier()
    assert len(ran) == 1 + 2


def test_a_state_is_handed_on():
    """Oracle: the number of calls, counted by the function itself in its state, whose memory it may use up."""
    seen = []

    def step(state, increment):
        jax.debug.callback(lambda value: seen.append(int(value)), state)
        return state + increment, 2 * state

    group = Group("g", MACHINE, Effort(3, 100.0, warm_up=1))
    group.chained("step", jax.jit(step, donate_argnums=0), jnp.zeros((), int), jnp.ones((), int), batch=5)
    jax.effects_barrier()
    assert sorted(seen) == [0, 1, 2, 3, 4]
    assert [(row.stage, row.batch, len(row.timing.warm_ms)) for row in group.rows] == [("step", 5, 3)]
