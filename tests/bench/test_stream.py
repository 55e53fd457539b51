"""What a stream costs besides its frames: the script's own arithmetic, and a whole quick run."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from stream import MOST_LOST, NUM_DROPPED, Built, Sweep, Watched, memory_rows, odd_rows, odd_sizes

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "stream.py"


def sweeps(num_scans: int, num_points: int):
    """Scans whose points and times say which they are."""
    for k in range(num_scans):
        yield Sweep(np.full((num_points, 3), k, np.float32), np.full(num_points, 1e-3 * k), k)


def watched(built: list[Built], resident_mb: list[float], kept_mb: list[float]) -> Watched:
    return Watched(built, resident_mb, kept_mb, [7] * len(resident_mb), ["ok"] * len(resident_mb))


def test_a_stream_of_odd_sizes():
    """Oracle: the counts of the specification, and means of a uniform share over many points: what is left is 1 - 0.9 u."""
    given, num_points = 100, 2000
    found = list(odd_sizes(sweeps(given + NUM_DROPPED, num_points), given))
    sizes = np.array([len(sweep.points) for sweep in found])
    stamps = [sweep.stamp_ns for sweep in found]
    assert len(found) == given
    assert set(range(given + NUM_DROPPED)) - set(stamps) == set(range(80, 80 + NUM_DROPPED))
    assert np.flatnonzero(sizes == 0).tolist() == [20]
    assert [k for k, sweep in enumerate(found) if sweep.times_s is None] == [60]
    assert [k for k, sweep in enumerate(found) if (sweep.points != sweep.stamp_ns).any()] == [40]
    assert all(len(sweep.times_s) == len(sweep.points) for sweep in found if sweep.times_s is not None)
    share = np.delete(sizes, 20) / num_points
    assert share.min() > 1.0 - MOST_LOST - 0.03
    assert share.min() < 0.2
    assert share.max() > 0.9
    again = list(odd_sizes(sweeps(given + NUM_DROPPED, num_points), given))
    assert all((one.points == other.points).all() for one, other in zip(found, again, strict=True))


@pytest.mark.parametrize(("grown_mb", "ok"), [(21.5, True), (22.5, False)])
def test_memory_grows_by_more_than_the_poses(grown_mb, ok):
    """Oracle: a staircase by hand: from 100 MB to so much more, of which 2 MB are poses."""
    resident = [90.0] * 100 + [100.0] * 100 + [100.0 + grown_mb] * 100
    growth, kept, most, built = memory_rows(watched([], resident, [3.0, 1.0]), 200)
    assert growth.value == pytest.approx(grown_mb - 2.0)
    assert growth.ok is ok
    assert (kept.value, most.value, built.value) == (2.0, 100.0 + grown_mb, 0.0)


@pytest.mark.parametrize(("late", "verdicts"), [(-1, (True, True)), (0, (True, False)), (3, (True, False))])
def test_what_is_built_while_a_scan_waits_is_a_miss(late, verdicts, capsys):
    """Oracle: the rule itself; -1 stands for before the first scan. Without any event before it, the listener is at fault."""
    built = [Built(-1, "compile", "encode", 1.0), Built(late, "trace", "solve", 1.0)]
    assert tuple(row.ok for row in odd_rows(watched(built, [1.0] * 5, []))[-2:]) == verdicts
    assert ("before the first scan" if late < 0 else f"scan {late}") in capsys.readouterr().out.splitlines()[-1]
    assert not odd_rows(watched([], [1.0] * 5, []))[-2].ok


@pytest.mark.slow
def test_a_quick_run():
    """Oracle: every bar of the script has a row, and there is no verdict; times themselves are not judged."""
    run = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True, check=True)
    assert "quick run, no verdict" in run.stdout
    for words in ("`import delo_jax`", "empty cache", "warm cache", "of odd sizes: traced or compiled", "growth after"):
        assert words in run.stdout
    assert "| NO |" not in run.stdout
