"""The benchmark beside other packages: who is timed when, the authors' transport, and the whole on small sizes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from delo_jax.bench.timing import NOT_BUILT, Timing, paired_ratio

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts import their neighbours

import _peers_drive  # noqa: E402
import _peers_networks  # noqa: E402
import _peers_turns as turns  # noqa: E402


class Clock:
    """Seconds, which pass only in calls and in pauses."""

    def __init__(self):
        self.now = 0.0

    def sleep(self, seconds):
        self.now += seconds


def test_everybody_is_first_equally_often():
    """Oracle: a Latin square by hand; in as many turns as there are names each of them has every place once."""
    orders = [turns.order(["a", "b", "c"], turn) for turn in range(6)]
    assert orders[:3] == [["a", "b", "c"], ["b", "c", "a"], ["c", "a", "b"]]
    assert orders[3:] == orders[:3]


def test_calls_take_turns_on_the_same_scans():
    """Oracle: calls of known length under a clock of the test's own; pauses, first call and warm-up do not count."""
    clock, log = Clock(), []

    def caller(name, seconds):
        def call(turn):
            log.append((turn, name))
            clock.now += seconds * (1 + turn)

        return call

    calls = {"slow": caller("slow", 0.2), "fast": caller("fast", 0.1)}
    found = turns.in_turns(calls, 3, warm_up=2, clock=turns.Clock(lambda: clock.now, clock.sleep))
    assert log == [(turn, name) for turn in range(5) for name in (("slow", "fast") if turn % 2 == 0 else ("fast", "slow"))]
    np.testing.assert_allclose(found["slow"].warm_ms, [600.0, 800.0, 1000.0])
    np.testing.assert_allclose(found["fast"].warm_ms, [300.0, 400.0, 500.0])
    np.testing.assert_allclose(found["fast"].first_ms, 100.0)
    np.testing.assert_allclose(paired_ratio(found["slow"], found["fast"]), 2.0)


def test_a_ratio_of_turns_forgets_one_that_was_disturbed():
    """Oracle: by hand; the ratios are 2, 5 and 2, while those of the medians are 5 and 1."""
    below, above = (Timing(NOT_BUILT, 0.0, values) for values in ((1.0, 1.0, 3.0), (2.0, 5.0, 6.0)))
    assert paired_ratio(above, below) == 2.0


def test_dense_products_are_the_loop_that_scales_rows_and_columns():
    """Oracle: the twin's loop, which multiplies rows and columns by vectors, in float64; and the total, which is the mass."""
    torch = pytest.importorskip("torch")
    from tests.oracles.published import clipped_transport

    cost = torch.from_numpy(np.random.default_rng(0).uniform(0.0, 6.0, size=(40, 30)))
    found = _peers_networks.dense_transport(cost, mass=0.7, num_iters=5)
    np.testing.assert_allclose(found, clipped_transport(cost, 1.0, 0.7, 5), rtol=1e-12)
    np.testing.assert_allclose(found.sum(), 0.7, rtol=1e-12)


def test_without_pytorch_the_remedy_is_named(monkeypatch):
    """Oracle: the name of the extra in pyproject.toml; importing a module that is None in `sys.modules` fails as a missing one does."""
    monkeypatch.setitem(sys.modules, "torch", None)
    assert "parity = [" in (ROOT / "pyproject.toml").read_text()
    assert "pip install '.[parity]'" in _peers_networks.torch_missing()


def test_gicp_to_a_map_follows_a_walk_through_a_room():
    """Oracle: the motion by which the points were made; a room of four walls and a floor, 0.2 m a scan, noise of 1 cm."""
    pytest.importorskip("small_gicp")
    rng, tracker, motion = np.random.default_rng(0), _peers_drive.GicpToMap(), np.eye(4)
    motion[0, 3] = 0.2
    for k in range(4):
        u, v = rng.uniform(-8.0, 8.0, size=(2, 20_000))
        wall = rng.integers(5, size=u.size)
        sides = np.stack([np.full_like(u, 8.0), u, 0.2 * v], axis=1) * np.where(wall % 2, -1.0, 1.0)[:, None]
        points = np.where((wall < 2)[:, None], sides, sides[:, [1, 0, 2]])
        points = np.where((wall == 4)[:, None], np.stack([u, v, np.full_like(u, -1.6)], axis=1), points)
        points = points + rng.normal(scale=0.01, size=points.shape) - [0.2 * k, 0.0, 0.0]
        found = tracker.track(_peers_drive.TrackedSweep(points, None, 0.1), np.eye(4))
        np.testing.assert_allclose(found.T_target_source, np.eye(4) if k == 0 else motion, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["networks", "paper", "drive"])
def test_a_quick_run(tmp_path, part):
    """Oracle: the rows that each part has to have; times themselves are not judged, the error of a step of each method is printed."""
    for package in ("torch", "kiss_icp", "small_gicp", "kiss_matcher"):
        pytest.importorskip(package)
    record = tmp_path / "record.json"
    command = [sys.executable, str(ROOT / "benchmarks" / "peers.py"), "--quick", "--parts", part, "--json", str(record)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "quick run, no verdict" in done.stdout
    rows = {row["metric"]: row for row in json.loads(record.read_text())["rows"]}
    expected = {
        "networks": ["network alone, tiny, N = 256 (its own): p50"],
        "paper": ["JAX, softmax head / PyTorch, softmax head", "both softmax networks: largest difference of the translation"],
        "drive": [f"delo run / {name}: p{percent}" for name in _peers_drive.PEERS for percent in (50, 95)],
    }
    assert set(expected[part]) <= set(rows)
    assert all(row["value"] >= 0 for row in rows.values())
    assert all(row["ok"] for metric, row in rows.items() if "largest difference" in metric)
