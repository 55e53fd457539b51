"""The noise of the truth of recorded drives: full-scan GICP started at the truth, minus the truth, per axis, drive and gap."""

import functools

import numpy as np
import small_gicp
from _peers import NUM_THREADS, Drive
from _uncertainty import relative
from rich.progress import Progress

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


def truth_noise(drive: Drive, gaps: tuple[int, ...], bar: Progress) -> dict[int, np.ndarray]:
    """By gap, (6,) standard deviations of the truth of a pair; prints a row for each."""
    prepare = functools.partial(small_gicp.preprocess_points, downsampling_resolution=0.25, num_threads=NUM_THREADS)
    clouds = [prepare(points.astype(np.float64)) for points in bar.track(compensated(drive), description=f"{drive.name}: GICP's clouds")]
    found = {}
    for gap in gaps:
        errors = []
        for k in bar.track(range(len(clouds) - gap), description=f"{drive.name}: GICP at gap {gap}"):
            T_true, (target, tree) = relative(drive.Ts_world_lidar, k, k + gap), clouds[k + gap]
            result = small_gicp.align(target, clouds[k][0], tree, T_true, max_correspondence_distance=1.0, num_threads=NUM_THREADS)
            errors.append(se3.log(se3.inverse(se3.orthonormal(np.asarray(result.T_target_source))) @ T_true))
        middle = np.median(errors, axis=0)
        found[gap] = 1.4826 * np.median(np.abs(np.array(errors) - middle[None]), axis=0)
        cells = " | ".join(f"{value:.2f}" for value in PRINTED * found[gap])
        rest = (", ".join(f"{value:.2f}" for value in PRINTED * numbers) for numbers in (middle, np.std(errors, axis=0)))
        print(f"| {drive.name} | {gap} | {len(errors)} | {cells} | {' | '.join(rest)} |", flush=True)
    return found
