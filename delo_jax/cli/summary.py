"""What a run amounts to, in rows with units."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from delo_jax.cli.console import Row
from delo_jax.cli.refinement import Refinement
from delo_jax.cli.tracking import Result, percentiles_ms
from delo_jax.metrics.ate import absolute_errors, relative_errors
from delo_jax.metrics.drift import SHORT_LENGTHS_M, Drift, mean_drift, segments_that_fit


def run_rows(result: Result) -> list[Row]:
    """Summary of a run: what was tracked, how fast, and how far off where there is a truth."""
    trajectory = result.trajectory
    statuses = ", ".join(f"{status} {count}" for status, count in Counter(trajectory.statuses).most_common())
    rows = [Row("scans", str(len(trajectory))), Row("path", f"{path_length(trajectory.Ts_world_lidar):.1f}", "m"), Row("status", statuses)]
    rows += timing_rows({name: seconds for name, seconds in result.timing.items() if name != "simulate"})  # no part of odometry
    if simulating := percentiles_ms(result.timing.get("simulate", np.zeros(0))):
        rows.append(Row("simulating (apart), p50 / p95", f"{simulating[0]:.0f} / {simulating[1]:.0f}", "ms"))
    if result.compile_s:
        rows.append(Row("compiling (apart)", f"{result.compile_s:.1f}", "s"))
    if len(trajectory) and not np.isfinite(trajectory.confidences).any():
        rows.append(Row("covariances", "none: the method does not say how sure it is"))
    if result.truth is not None and len(trajectory) > 1:
        rows += accuracy_rows(trajectory.Ts_world_lidar, result.truth)
    return rows


def refinement_rows(found: Refinement, Ts_before: np.ndarray, Ts_true: np.ndarray | None) -> list[Row]:
    """What the graph consists of, what it took, and errors before and after."""
    factors = ", ".join(f"{kind} {count}" for kind, count in found.num_factors.items())
    result = [Row("factors of the graph", factors)]
    if found.counts:
        result.append(
            Row(
                "passes of key frames, and those without a pose", ", ".join(f"{what} {count}" for what, count in found.counts.most_common())
            )
        )
    for what, seconds in (("network passes", found.pass_s), ("smoother", found.smooth_s)):
        p50, p95 = 1e3 * np.percentile(seconds, [50, 95])
        result.append(Row(f"{what} a frame, second thread, p50 / p95", f"{p50:.1f} / {p95:.1f}", "ms"))
    result.append(Row("whole graph", f"{found.solve_s:.2f}", "s"))
    if not found.refined.converged:
        result.append(Row("whole graph", "has not converged"))
    if Ts_true is not None and len(Ts_true) > 2:
        result += _errors_of(found, Ts_before, Ts_true)
    return result


def _errors_of(found: Refinement, Ts_before: np.ndarray, Ts_true: np.ndarray) -> list[Row]:
    poses = {"odometry": Ts_before, "smoothed on the way": found.Ts_online, "refined": found.refined.Ts_world_lidar}
    names = " / ".join(poses)
    ates = " / ".join(f"{100 * absolute_errors(Ts, Ts_true).rmse_m:.2f}" for Ts in poses.values())
    result = [Row(f"ATE: {names}", ates, "cm")]
    drifts = [drift_where_it_fits(Ts, Ts_true) for Ts in poses.values()]
    if drifts[0] is not None:
        span = span_of(drifts[0])
        for unit, values in (
            ("%", [drift.t_rel_percent for drift in drifts if drift is not None]),
            ("deg/100 m", [drift.r_rel_deg_per_100m for drift in drifts if drift is not None]),
        ):
            result.append(Row(f"drift over {span}: the same", " / ".join(f"{value:.3f}" for value in values), unit))
    return result


def timing_rows(timing: dict[str, np.ndarray]) -> list[Row]:
    """Median and 95th percentile per stage and of their sum, and the scans per second that it amounts to."""
    whole = np.nansum(list(timing.values()), axis=0)
    found = {name: percentiles_ms(seconds) for name, seconds in (timing | {"whole scan": whole}).items()}
    rows = [Row(f"{name}, p50 / p95", f"{both[0]:.0f} / {both[1]:.0f}", "ms") for name, both in found.items() if both]
    return rows + ([Row("rate", f"{len(whole) / whole.sum():.1f}", "scans/s")] if whole.any() else [])


def accuracy_rows(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> list[Row]:
    """Errors of the steps, and the drift over the segments that fit on the path."""
    errors = relative_errors(Ts_estimated, Ts_true)
    rows = [
        Row("error of a step (median)", f"{100 * np.median(errors.translation_m):.1f}", "cm"),
        Row("error of a step (median)", f"{np.rad2deg(np.median(errors.rotation_rad)):.3f}", "deg"),
    ]
    drift = drift_where_it_fits(Ts_estimated, Ts_true)
    if drift is None:
        return rows + [Row("drift", "-", f"path below {SHORT_LENGTHS_M[0]:g} m")]
    span = span_of(drift)
    return rows + [
        Row(f"drift over {span}", f"{drift.t_rel_percent:.2f}", "%"),
        Row(f"drift over {span}", f"{drift.r_rel_deg_per_100m:.2f}", "deg/100 m"),
    ]


def drift_where_it_fits(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> Drift | None:
    """Mean drift over the segments that fit, None on paths below 10 m."""
    segments = segments_that_fit(Ts_estimated, Ts_true)
    return None if segments is None else mean_drift(segments)


def span_of(drift: Drift) -> str:
    """The segment lengths that did fit, such as "10-50 m"."""
    fitting = drift.lengths_m[drift.num_segments_by_length > 0]
    return f"{fitting[0]:g}-{fitting[-1]:g} m" if len(fitting) > 1 else f"{fitting[0]:g} m"


def path_length(Ts: np.ndarray) -> float:
    """Sum of the distances between successive positions [m]."""
    return float(np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=-1).sum())


def rejected_lines(result: Result, names: Sequence[object], limit: int = 5) -> list[str]:
    """One sentence for each of the first rejected scans, naming its file."""
    rejected = [record for record in result.trajectory.records if record.status == "rejected"]
    lines = []
    for record in rejected[:limit]:
        name = str(names[record.number])
        lines.append(record.reason if record.reason.startswith(name) else f"{name}: {record.reason}")
    more = len(rejected) - limit
    return lines + ([f"and {more} more; frames.csv has them all"] if more > 0 else [])
