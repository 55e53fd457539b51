"""report.html of a run: its files read again, measured and put into words."""

import csv
import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from delo_jax.cli.refinement import Refinement
from delo_jax.cli.stored import facts_of
from delo_jax.cli.summary import drift_where_it_fits, path_length, span_of
from delo_jax.data.poses import read_tum
from delo_jax.metrics.ate import absolute_errors, relative_errors
from delo_jax.metrics.calibration import coverage
from delo_jax.report.cloud import DriveCloud
from delo_jax.report.html import Card, Report, render
from delo_jax.report.page_data import Frames, Refined, errors, motions, sigmas_of

NAME = "report.html"
APART = "simulate"
"""A stage that is no part of odometry."""
LEVELS = (0.68, 0.95)


def write_page(
    folder: Path, cloud: DriveCloud, *, truth: np.ndarray | None = None, refinement: Refinement | None = None, loops: int | None = None
) -> Path:
    """Writes report.html into the folder of a run and returns its path.

    Args:
        folder: of a run, complete or interrupted, of one or more frames.
        cloud: what was gathered on the way.
        truth: (n, 4, 4) of the run's frames.
        refinement: the pose graph, of which the cloud gets the poses.
        loops: how many were closed; None where nobody looked for any.
    """
    facts, frames = facts_of(folder), _frames(folder)
    count = len(frames.statuses)
    if truth is not None and (len(truth) < count or not np.isfinite(truth[:count]).all()):
        truth = None
    refined = None
    if refinement is not None and len(refinement.refined.Ts_world_lidar) == count:
        refined = Refined(refinement.refined.Ts_world_lidar, refinement.refined.covariances)
    report = _report(folder, facts, frames, cloud, None if truth is None else truth[:count], refined, loops)
    part = folder / f"{NAME}.part"
    part.write_text(render(report), encoding="utf-8")
    os.replace(part, folder / NAME)
    return folder / NAME


def _frames(folder: Path) -> Frames:
    """Whole frames of the run's files."""
    stamps_ns, Ts = read_tum(folder / "trajectory.tum")
    covariances, pose_covariances = (np.load(folder / f"{name}.npy") for name in ("covariances", "pose_covariances"))
    with (folder / "frames.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    count = min(len(rows), len(Ts), len(covariances), len(pose_covariances))
    rows = rows[:count]
    stages = [name for name in (rows[0] if rows else {}) if name.endswith("_ms")]
    timing = {name.removesuffix("_ms"): 1e-3 * np.array([_number(row[name]) for row in rows]) for name in stages}
    return Frames(
        stamps_ns=stamps_ns[:count],
        statuses=[row["status"] for row in rows],
        reasons=[row["reason"] for row in rows],
        confidences=np.array([_number(row["confidence"]) for row in rows]),
        since=np.array([int(row["since_index"]) for row in rows], np.int64),
        Ts_world_lidar=Ts[:count],
        motion_covariances=covariances[:count],
        pose_covariances=pose_covariances[:count],
        timing_s={name: seconds for name, seconds in timing.items() if name != APART and np.isfinite(seconds).any()},
    )


def _number(cell: str) -> float:
    return float(cell) if cell else np.nan


def _report(
    folder: Path,
    facts: dict[str, Any],
    frames: Frames,
    cloud: DriveCloud,
    truth: np.ndarray | None,
    refined: Refined | None,
    loops: int | None,
) -> Report:
    cards = [*(_accuracy(frames, truth, refined) if truth is not None and len(truth) > 1 else []), *_always(frames, refined, loops)]
    notes = [] if _has_uncertainty(frames) else ["This method says nothing of its errors: there are no bands, ellipses and sigmas to show."]
    if truth is None:
        notes.append("No truth is known for this run, so errors are not shown.")
    name = (facts.get("dataset") or {}).get("name") or folder.name
    return Report(
        title=name[:1].upper() + name[1:] if name == "simulated drive" else name,
        subtitle=_subtitle(facts, frames),
        verdict=_verdict(facts, frames, refined, loops),
        cards=cards,
        notes=notes,
        frames=frames,
        cloud=cloud.placed(frames.Ts_world_lidar if refined is None else refined.Ts_world_lidar),
        truth=truth,
        refined=refined,
        making=_making(facts, cloud),
        config=(folder / "config.toml").read_text(encoding="utf-8"),
    )


def _subtitle(facts: dict[str, Any], frames: Frames) -> str:
    count, total = len(frames.statuses), facts.get("num_scans", 0)
    scans = f"{count} scan{'' if count == 1 else 's'}" if count == total else f"{count} of {total} scans"
    seconds = 1e-9 * float(frames.stamps_ns[-1] - frames.stamps_ns[0])
    return " · ".join(
        [(facts.get("dataset") or {}).get("layout") or "scans", scans, f"{path_length(frames.Ts_world_lidar):.1f} m", f"{seconds:.1f} s"]
    )


def _verdict(facts: dict[str, Any], frames: Frames, refined: Refined | None, loops: int | None) -> str:
    counts = Counter(frames.statuses)
    how = f"{counts['ok']} of {len(frames.statuses)} frames are ok"
    if counts["ok"] == len(frames.statuses):
        how = "Every frame is ok"
    whole_s = _whole_s(frames)
    pace = f"{1e3 * np.median(whole_s):.0f} ms a scan in the median" if whole_s.any() else "not timed"
    method = facts.get("method", "delo")
    where = {"local": "on a local map", "none": "from scan to scan"}.get(str(facts.get("map")), "") if method == "delo" else f"by {method}"
    with_loops = f"with {loops} loop{'' if loops == 1 else 's'}" if loops else "without loops"
    graph = "not refined" if refined is None else f"refined by a pose graph {with_loops}"
    state = "; the run was interrupted" if facts.get("state") == "interrupted" else ""
    return f"{how}: {', '.join(filter(None, [where, pace, graph]))}{state}."


def _whole_s(frames: Frames) -> np.ndarray:
    return np.nansum([np.zeros(len(frames.statuses)), *frames.timing_s.values()], axis=0)


def _has_uncertainty(frames: Frames) -> bool:
    return bool(np.isfinite(frames.pose_covariances).any())


def _accuracy(frames: Frames, truth: np.ndarray, refined: Refined | None) -> list[Card]:
    """Cards of what the truth says; where there is a refined track, its numbers are in the notes."""
    Ts = frames.Ts_world_lidar
    after = None if refined is None else refined.Ts_world_lidar
    cards = []
    drift, drift_after = (None if one is None else drift_where_it_fits(one, truth) for one in (Ts, after))
    if drift is not None:
        note = f"{drift.r_rel_deg_per_100m:.2g} deg/100 m; over {span_of(drift)}"
        if drift_after is not None:
            note += f"; refined {drift_after.t_rel_percent:.2g} %, {drift_after.r_rel_deg_per_100m:.2g} deg/100 m"
        cards.append(Card("Drift", f"{drift.t_rel_percent:.2g}", "%", note))
    ate, ate_after = (None if one is None else 100 * absolute_errors(one, truth).rmse_m for one in (Ts, after))
    note = "RMSE of the positions after alignment" + ("" if ate_after is None else f"; refined {ate_after:.3g} cm")
    cards.append(Card("Absolute error (ATE)", f"{ate:.3g}", "cm", note))
    steps = relative_errors(Ts, truth)
    t_cm, r_deg = 100 * np.median(steps.translation_m), np.rad2deg(np.median(steps.rotation_rad))
    cards.append(Card("Error of a step", f"{t_cm:.2g}", "cm", f"median of the motions between scans; {r_deg:.2g} deg"))
    if _has_uncertainty(frames):
        of_motions = _coverage(errors(motions(Ts, frames.since), motions(truth, frames.since)), frames.motion_covariances)
        of_poses = _coverage(errors(Ts, truth), frames.pose_covariances)
        note = f"of the motions are within; poses {of_poses}"
        if refined is not None:
            note += f", refined {_coverage(errors(refined.Ts_world_lidar, truth), refined.covariances)}"
        cards.append(Card("Intervals of 68 / 95 %", of_motions, "%", note))
    return cards


def _coverage(twists: np.ndarray, covariances: np.ndarray) -> str:
    """Shares of errors within the intervals, mean over the axes [%]; poses that are exact by definition do not count."""
    sigmas = sigmas_of(covariances)
    counted = (np.isfinite(sigmas) & (sigmas > 0)).all(axis=1)
    if not counted.any():
        return "–"
    return " / ".join(f"{100 * coverage(twists[counted], sigmas[counted], level).mean():.0f}" for level in LEVELS)


def _always(frames: Frames, refined: Refined | None, loops: int | None) -> list[Card]:
    """Cards that need no truth."""
    cards = [Card("Path", f"{path_length(frames.Ts_world_lidar):.1f}", "m")]
    whole_s = _whole_s(frames)
    if whole_s.any():
        p50, p95 = 1e3 * np.percentile(whole_s, [50, 95])
        cards.append(
            Card(
                "Rate",
                f"{len(whole_s) / whole_s.sum():.1f}",
                "scans/s",
                f"a scan takes {p50:.0f} ms in the median, {p95:.0f} ms at the 95th percentile",
            )
        )
    if _has_uncertainty(frames) and len(frames.statuses) > 1:
        last = sigmas_of(frames.pose_covariances[-1:] if refined is None else refined.covariances[-1:])[0]
        metres = float(np.linalg.norm(last[3:]))
        value, unit = (100 * metres, "cm") if metres < 1 else (metres, "m")
        what = "refined pose" if refined is not None else "pose"
        cards.append(Card("Sigma at the end", f"{value:.3g}", unit, f"of the {what}; heading {np.rad2deg(last[2]):.2g} deg"))
    note = "places that were seen again" if loops is not None else "nobody looked for places that were seen again"
    return cards + [Card("Loops closed", str(loops or 0), "", note)]


def _making(facts: dict[str, Any], cloud: DriveCloud) -> list[tuple[str, str]]:
    """How the run was made, as run.json has it."""
    dataset, sensor, weights = (facts.get(name) or {} for name in ("dataset", "sensor", "weights"))
    where = " ".join(filter(None, [dataset.get("path"), dataset.get("sequence")]))
    rows = [("data", ", ".join(filter(None, [dataset.get("layout"), where]))), ("truth", facts.get("truth") or "none")]
    rows.append(("method", facts.get("method", "delo") + (f", map: {facts['map']}" if facts.get("map") else "")))
    rows.append(("de-skew", sensor.get("deskew", "unknown")))
    if sensor.get("elevation_correction_deg"):
        rows.append(("elevation", f"corrected by {sensor['elevation_correction_deg']:+g} deg"))
    rows.append(("uncertainty", str(facts.get("uncertainty", "unknown"))))
    if weights:
        rows.append(("weights", f"{weights.get('name')}, SHA-256 {weights.get('sha256')}"))
    rows.append(("versions", ", ".join(f"{name} {number}" for name, number in (facts.get("versions") or {}).items())))
    if facts.get("compile_s"):
        rows.append(("compiling", f"{facts['compile_s']:.1f} s, not part of the time per scan"))
    rows.append(("map in this page", f"one point per {100 * cloud.voxel_m:.0f} cm voxel, the first that was seen within 45 m"))
    return rows
