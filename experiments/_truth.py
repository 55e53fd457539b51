"""The noise of the truth of recorded drives: full-scan GICP started at the truth, minus the truth, per axis, drive and gap."""

from typing import NamedTuple

import numpy as np
from _peers import Drive
from _uncertainty import relative
from rich.progress import Progress

from delo_jax.baselines.gicp import Gicp
from delo_jax.geometry import se3
from delo_jax.geometry.deskew import deskew
from delo_jax.pipeline.motion_model import NANOSECOND
from delo_jax.uncertainty.observability import AXES

PRINTED = np.repeat([1e3, 100.0], 3)  # mrad, cm
UNITS = ("mrad",) * 3 + ("cm",) * 3


def compensated(drive: Drive) -> list[np.ndarray]:
    """Points of every sweep, de-skewed with the true velocity where they carry times."""
    if not drive.skewed:
        return [sweep.points for sweep in drive.sweeps]
    found = []
    for k, sweep in enumerate(drive.sweeps):
        first, last = max(k - 1, 0), min(k + 1, len(drive.sweeps) - 1)
        motion = se3.inverse(drive.Ts_world_lidar[first]) @ drive.Ts_world_lidar[last]
        velocity = se3.log(motion) / ((drive.sweeps[last].stamp_ns - drive.sweeps[first].stamp_ns) * NANOSECOND)
        found.append(sweep.points if sweep.times_s is None else deskew(sweep.points, sweep.times_s, velocity))
    return found


def noise_header() -> str:
    """Of the table that `truth_noise` prints the rows of."""
    cells = " | ".join(f"{axis}: {unit}" for axis, unit in zip(AXES, UNITS, strict=True))
    return f"| drive | gap | pairs | {cells} | medians | standard deviations |\n|---|---:|---:|{'---:|' * 6}---|---|"


class Noise(NamedTuple):
    """Of the truth of a pair, (6,) each."""

    robust: np.ndarray  # 1.4826 times the median distance from the median
    deviation: np.ndarray  # standard deviation, which holds the tails: a heading that drifts


def truth_noise(drive: Drive, gaps: tuple[int, ...], bar: Progress) -> dict[int, Noise]:
    """By gap; prints a row for each."""
    gicp = Gicp(gate_m=1.0)
    clouds = [gicp.prepare(points) for points in bar.track(compensated(drive), description=f"{drive.name}: GICP's clouds")]
    found = {}
    for gap in gaps:
        errors = []
        for k in bar.track(range(len(clouds) - gap), description=f"{drive.name}: GICP at gap {gap}"):
            T_true = relative(drive.Ts_world_lidar, k, k + gap)
            T = gicp.align(clouds[k], clouds[k + gap], T_true).T_target_source
            errors.append(se3.log(se3.inverse(se3.orthonormal(T)) @ T_true))
        middle = np.median(errors, axis=0)
        noise = found[gap] = Noise(1.4826 * np.median(np.abs(np.array(errors) - middle[None]), axis=0), np.std(errors, axis=0))
        cells = " | ".join(f"{value:.2f}" for value in PRINTED * noise.robust)
        rest = (", ".join(f"{value:.2f}" for value in PRINTED * numbers) for numbers in (middle, noise.deviation))
        print(f"| {drive.name} | {gap} | {len(errors)} | {cells} | {' | '.join(rest)} |", flush=True)
    return found
