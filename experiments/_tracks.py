"""What an odometry made of a drive, and what is said of it: drift, error per step, time, and the tables that show them."""

from typing import NamedTuple

import numpy as np

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.metrics.ate import relative_errors
from delo_jax.metrics.drift import kitti_drift

GAP = 3  # of the thinned drives
NUM_WARM_UP = 5  # scans whose time does not count: they compile
SHORT_M, LONG_M = tuple(range(10, 51, 10)), tuple(range(60, 101, 10))
LOST_PERCENT, LOST_STEP_M = 10.0, 1.0
NOWHERE = np.eye(4) + 1e6 * np.eye(4, k=3)  # in place of a pose that is not finite


class Track(NamedTuple):
    """What a method made of a drive."""

    Ts_world_lidar: np.ndarray
    seconds: np.ndarray
    ok: float  # share of the frames with this status; NaN for the peers, which have none

    def thinned(self) -> "Track":
        """Every third pose."""
        return self._replace(Ts_world_lidar=self.Ts_world_lidar[::GAP])


class Numbers(NamedTuple):
    """What is said of a track; NaN where the drive is too short."""

    percent: float
    deg: float  # per 100 m
    long_percent: float
    long_deg: float
    step_cm: float  # median
    step_deg: float
    p50_ms: float
    p95_ms: float
    ok: float
    worst_m: float  # largest error of a step

    @property
    def lost(self) -> bool:
        """Whether the drive was lost."""
        return self.percent > LOST_PERCENT or self.worst_m > LOST_STEP_M


Table = dict[str, Numbers]


def numbers(track: Track, Ts_true: np.ndarray) -> Numbers:
    """A track against the truth."""
    usable = np.isfinite(track.Ts_world_lidar).all(axis=(1, 2), keepdims=True)
    Ts = np.where(usable, track.Ts_world_lidar, NOWHERE)
    steps = relative_errors(Ts, Ts_true)
    milliseconds = 1e3 * track.seconds[min(NUM_WARM_UP, len(track.seconds) // 2) :]
    return Numbers(
        *drift(Ts, Ts_true, SHORT_M),
        *drift(Ts, Ts_true, LONG_M),
        100 * float(np.median(steps.translation_m)),
        float(np.degrees(np.median(steps.rotation_rad))),
        float(np.median(milliseconds)),
        float(np.percentile(milliseconds, 95)),
        track.ok,
        float(steps.translation_m.max()),
    )


def drift(Ts: np.ndarray, Ts_true: np.ndarray, lengths_m: tuple[int, ...]) -> tuple[float, float]:
    """Percent and degrees per 100 m, from every start; NaN where the drive is shorter than all segments."""
    try:
        found = kitti_drift(Ts, Ts_true, lengths_m=lengths_m, step=1)
    except DeloError:
        return np.nan, np.nan
    return found.t_rel_percent, found.r_rel_deg_per_100m


def show(title: str, table: Table) -> None:
    """All numbers of the methods on a drive."""
    print(f"\n## {title}\n\n| method | 10-50 m: % | deg/100 m | 60-100 m: % | deg/100 m | step: cm | deg | p50 ms | p95 ms | ok % |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name, n in table.items():
        cells = " | ".join(_cell(value, 3) for value in n[:6])
        print(f"| {name} | {cells} | {n.p50_ms:.1f} | {n.p95_ms:.1f} | {_cell(100 * n.ok, 1)} |", flush=True)


def show_thinned(title: str, thin: Table, whole: Table, same: Table) -> None:
    """Every third scan beside all of them: as in the table above, and over the same segments, which end at thinned scans."""
    print(f"\n## {title}, every third scan\n")
    print("| method | 10-50 m: % | deg/100 m | worst step m | ok % | lost | % / that of all scans | over the same segments |")
    print("|---|---:|---:|---:|---:|---|---:|---:|")
    for name, n in thin.items():
        ratios = " | ".join(_cell(n.percent / table[name].percent, 2) for table in (whole, same))
        cells = " | ".join(_cell(c, 3) for c in (n.percent, n.deg, n.worst_m))
        print(f"| {name} | {cells} | {_cell(100 * n.ok, 1)} | {'LOST' if n.lost else ''} | {ratios} |", flush=True)


def _cell(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def mean(tables: list[Table]) -> Table:
    """Mean over drives, method by method."""
    return {name: Numbers(*np.mean([table[name] for table in tables], axis=0).tolist()) for name in tables[0]}


def swing_deg(Ts_world_lidar: np.ndarray) -> float:
    """Median change of the pitch and roll rates from scan to scan [deg per scan]."""
    motions = se3.log(se3.inverse(Ts_world_lidar[:-1]) @ Ts_world_lidar[1:])
    return float(np.degrees(np.median(np.linalg.norm(np.diff(motions[:, :2], axis=0), axis=1))))
