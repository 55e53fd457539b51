"""Times of calls under a clock that the test moves, and what the compiler says of functions whose cost is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from delo_jax.bench.timing import NOT_BUILT, Effort, Timing, built, nothing_kept, repeated


class Clock:
    """Seconds, which pass only when it is told."""

    def __init__(self, tick_s=0.0):
        self.now, self._tick_s = 0.0, tick_s

    def __call__(self):
        self.now += self._tick_s
        return self.now


def sleeper(clock, first_s, later_s):
    """A function that takes so long, by the clock."""
    durations = iter([first_s])

    def call(*_):
        clock.now += next(durations, later_s)
        return clock.now

    return call


def test_first_call_and_warm_calls_are_apart():
    """Oracle: sleeps of known length under a clock of the test's own; what is made before a call does not count."""
    clock = Clock()
    made = []

    def setup():
        clock.now += 7.0
        made.append(clock.now)
        return (len(made),)

    _, timing = repeated(sleeper(clock, 0.5, 0.02), Effort(6, 1000.0, warm_up=3), setup=setup, clock=clock)
    np.testing.assert_allclose(timing.first_ms, 500.0)
    np.testing.assert_allclose(timing.warm_ms, [20.0] * 6, rtol=1e-9)
    assert len(made) == 1 + 3 + 6
    assert timing.build is NOT_BUILT


@pytest.mark.parametrize(("budget_s", "num_calls"), [(0.35, 4), (0.0, 2), (100.0, 9)])
def test_the_budget_ends_the_calls(budget_s, num_calls):
    """Oracle: by hand; calls of 0.1 s go on until the budget has passed, and at least twice, at most nine times."""
    clock = Clock()
    _, timing = repeated(sleeper(clock, 0.1, 0.1), Effort(9, budget_s, min_calls=2, warm_up=0), clock=clock)
    assert len(timing.warm_ms) == num_calls


def test_a_slow_function_is_not_warmed_up():
    """Oracle: the number of calls; one call takes more than the budget."""
    clock, calls = Clock(), []
    sleep = sleeper(clock, 5.0, 4.0)
    repeated(lambda: calls.append(sleep()), Effort(9, 1.0, min_calls=2, warm_up=5), clock=clock)
    assert len(calls) == 1 + 2


def test_percentiles_leave_out_what_did_not_run():
    """Oracle: by hand, for 0 to 100 ms in any order, with calls that did not run among them."""
    values = np.random.default_rng(0).permutation(np.r_[np.arange(101.0), [np.nan] * 9])
    timing = Timing(NOT_BUILT, 0.0, tuple(values))
    assert [timing.percentile(percent) for percent in (50, 95, 99)] == [50.0, 95.0, 99.0]
    assert np.isnan(Timing(NOT_BUILT, 0.0, (np.nan,)).percentile(50))


def test_operations_and_bytes_of_a_product():
    """Oracle: closed form, 2 n m k operations; three matrices of four bytes an entry are read or written, and all that is kept."""
    n, m, k = 48, 80, 112
    executable, build = built(jax.jit(lambda a, b: a @ b), jnp.ones((n, k)), jnp.ones((k, m)))
    sizes = 4 * (n * k + k * m + n * m)
    assert build.cost.flops == 2 * n * m * k
    assert build.cost.bytes_accessed == sizes
    assert build.cost.peak_bytes == sizes
    np.testing.assert_allclose(executable(jnp.ones((n, k)), jnp.ones((k, m))), k)


def test_the_body_of_a_loop_counts_once():
    """Oracle: closed form of one product, of ten that are looped over."""
    square = jnp.ones((64, 64))
    _, build = built(jax.jit(lambda a: jax.lax.fori_loop(0, 10, lambda _, x: x @ a, a)), square)
    assert 2 * 64**3 <= build.cost.flops < 1.1 * 2 * 64**3


def test_tracing_lowering_and_compiling_are_apart():
    """Oracle: a clock that moves by a second whenever it is read."""
    _, build = built(jax.jit(lambda a: a + 1.0), jnp.ones(3), clock=Clock(1.0))
    assert build[:3] == (1000.0, 1000.0, 1000.0)


@pytest.fixture
def kept_in(tmp_path):
    """A folder in which JAX keeps whatever it compiles."""
    names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes"
    before = {name: jax.config.values[name] for name in names}
    for name, value in zip(names, (str(tmp_path), 0.0, -1), strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_compiled_code_on_disk_is_left_aside(kept_in):
    """Oracle: the files of the folder, none from within, some from after."""
    with nothing_kept():
        built(jax.jit(lambda a: a * 3.25), jnp.ones(5))
        assert not list(kept_in.iterdir())
    built(jax.jit(lambda a: a * 4.25), jnp.ones(5))
    assert list(kept_in.iterdir())
