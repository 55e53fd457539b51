"""Times of a stream: scan to scan with the last scan encoded already, on a local map, and what refines it in a second thread."""

import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np

from delo_jax import inference
from delo_jax.bench.rows import Group
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.model.delo import Model
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.refine.refiner import Refiner, Tracked
from delo_jax.sim import SimulatedScan


class Groups(NamedTuple):
    """What takes the rows of `measure_stream`."""

    on_map: Group
    refinement: Group


def _timed(function: Callable, *args) -> tuple[object, float]:
    """Result and milliseconds of a call, until the result is there."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    return result, 1e3 * (time.perf_counter() - begin)


def measure_scan_to_scan(params: Model, scans: list[np.ndarray], num_scans: int, warm_up: int, group: Group) -> None:
    """Adds preprocess, encode, align and total per scan; the older scan of each pair is encoded already.

    Args:
        params: weights.
        scans: raw scans (n, 3) [m], taken in turns.
        num_scans: that count.
        warm_up: scans before them.
        group: takes the rows.
    """
    times: dict[str, list[float]] = {"preprocess": [], "encode": [], "align": [], "total": []}
    source = inference.prepare(params, scans[0])
    jax.block_until_ready(source.encoding)
    for number in range(warm_up + num_scans):
        begin = time.perf_counter()
        target = inference.prepare(params, scans[(number + 1) % len(scans)])
        preprocess_ms = 1e3 * (time.perf_counter() - begin)
        _, encode_ms = _timed(lambda scan: scan.encoding, target)
        _, align_ms = _timed(inference.align, params, source, target, np.eye(4))
        source = target
        if number >= warm_up:
            for name, value in zip(times, (preprocess_ms, encode_ms, align_ms, preprocess_ms + encode_ms + align_ms), strict=True):
                times[name].append(value)
    for name, values in times.items():
        group.add(name, values)


def measure_stream(params: Model, drive: Iterable[SimulatedScan], warm_up: int, groups: Groups) -> None:
    """Adds the stages of `LidarOdometry`, insert NaN where a scan is not taken into the map, and those of `Refiner` per scan.

    Args:
        params: weights.
        drive: scans as measured.
        warm_up: of these, the first ones, which do not count.
        groups: take the rows.
    """
    groups.on_map.product()
    odometry, names, frames = LidarOdometry(params), ("prepare", "solve", "insert"), []
    for number, scan in enumerate(drive):
        frame = odometry.register(scan.points, number * FRAME_PERIOD_NS, scan.times_s)
        frames.append((frame.timing, Tracked(frame.since, frame.T_world_lidar, frame.covariance, frame.local, odometry.last_scan)))
    counted = [timing for timing, _ in frames[warm_up:]]
    for name in names:
        groups.on_map.add(name, [1e3 * timing.get(name, np.nan) for timing in counted])
    groups.on_map.add("total", [1e3 * sum(timing.values()) for timing in counted])
    with Refiner(params) as refiner:
        for _, tracked in frames:
            refiner.add(tracked)
    groups.refinement.add("network passes", (1e3 * np.array(refiner.record.pass_s[warm_up:])).tolist())
    groups.refinement.add("smoother", (1e3 * np.array(refiner.record.smooth_s[warm_up:])).tolist())
