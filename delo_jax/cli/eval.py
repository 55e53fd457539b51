"""`delo eval`: how far a run, or any trajectory, is from the truth."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import tyro

from delo_jax.cli.command import Command
from delo_jax.cli.compared import WORDS, Compared, of_file, of_run
from delo_jax.errors import ConfigError

if TYPE_CHECKING:
    from delo_jax.metrics.drift import Segments

GAPS = (1, 2, 5)
UNITS = ("%", "deg/100 m")


class Line(NamedTuple):
    """One row of a table."""

    what: str
    translation: float
    translation_unit: str
    rotation: float
    rotation_unit: str
    digits: tuple[int, int] = (3, 3)

    def cells(self) -> tuple[str, str, str, str, str]:
        """The numbers as text; nothing where there is none."""
        numbers = zip((self.translation, self.rotation), self.digits, strict=True)
        t, r = ("" if np.isnan(value) else f"{value:.{digits}f}" for value, digits in numbers)
        return self.what, t, self.translation_unit, r, self.rotation_unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Command):
    """Drift, absolute and relative errors of a run, or of a trajectory file, against the truth.

    Example: delo eval runs/07 --truth poses/07.txt

    Other people's trajectories: delo eval theirs.txt --truth poses/07.txt --calib sequences/07/calib.txt
    """

    track: tyro.conf.Positional[Path]
    """Folder of a run, or a file of KITTI rows or TUM lines."""
    truth: Path | None = None
    """KITTI rows (camera frame, where the run has a calibration) or a TUM file; by default the truth of the run's own dataset."""
    calib: Path | None = None
    """KITTI calib.txt, whose Tr leads from one to the other where estimate and truth are in different frames (camera, LiDAR)."""
    gap: list[int] = dataclasses.field(default_factory=lambda: list(GAPS))  # a list, which TOML has, too
    """Relative errors over so many frames."""
    refined: bool = False
    """Of the poses that `delo refine` or `delo run --refine` has left, rather than those of the odometry."""
    json: Path | None = None
    """Also write all numbers here."""

    def run(self) -> int:
        """Prints the frames and two tables."""
        from delo_jax.cli.console import print_table
        from delo_jax.metrics.drift import segments_that_fit

        if self.track.is_dir() or not self.track.exists():
            found = of_run(self.track, truth=self.truth, calib=self.calib, refined=self.refined)
        else:
            if self.refined:
                raise ConfigError(f"--refined: expected the folder of a run, got the file {self.track}; give the file of the refined poses")
            found = of_file(self.track, truth=self.truth, calib=self.calib)
        Ts_estimated, Ts_true = found.estimate.Ts, found.truth.Ts
        segments = segments_that_fit(Ts_estimated, Ts_true)
        errors = [*_drift_lines(segments), *_ate_lines(Ts_estimated, Ts_true), *_gap_lines(Ts_estimated, Ts_true, tuple(self.gap))]
        speeds = _speed_lines(segments)
        for line in _header(found):
            print(line)
        if segments is None:
            print(f"no drift: expected a path of more than 10 m, got {_path_length(Ts_true):.1f} m; relative errors alone")
        header = ("", "translation", "", "rotation", "")
        print_table(f"errors, {WORDS[found.frame]}", header, [line.cells() for line in errors], right=(1, 3))
        if speeds:
            print_table("drift by speed of the segment (0.1 s a frame)", header, [line.cells() for line in speeds], right=(1, 3))
        if self.json is not None:
            _write_json(self.json, found, errors + speeds)
        return 0


def _header(found: Compared) -> list[str]:
    """What is compared with what, and in which frame."""
    sides = [
        f"{word}: {side.name}" + (f"; {side.says}" if side.says else "")
        for word, side in (("estimate", found.estimate), ("truth", found.truth))
    ]
    return [*sides, f"{len(found.truth.Ts)} frames, errors in the {WORDS[found.frame]}", *found.notes]


def _path_length(Ts: np.ndarray) -> float:
    from delo_jax.cli.summary import path_length

    return path_length(Ts)


def _drift_lines(segments: "Segments | None") -> list[Line]:
    from delo_jax.cli.summary import span_of
    from delo_jax.metrics.drift import mean_drift

    if segments is None:
        return [Line("drift (path below 10 m)", np.nan, UNITS[0], np.nan, UNITS[1])]
    drift = mean_drift(segments)
    columns = drift.lengths_m, drift.num_segments_by_length, drift.t_rel_percent_by_length, drift.r_rel_deg_per_100m_by_length
    rows = [(f"drift over {length:g} m ({count} segments)", t, r) for length, count, t, r in zip(*columns, strict=True) if count]
    rows.append((f"drift over {span_of(drift)}, mean of {drift.num_segments}", drift.t_rel_percent, drift.r_rel_deg_per_100m))
    return [Line(what, float(t), UNITS[0], float(r), UNITS[1]) for what, t, r in rows]


def _speed_lines(segments: "Segments | None") -> list[Line]:
    """The benchmark's classes, those with fewer than three segments left out."""
    from delo_jax.metrics.drift import KITTI_MIN_SEGMENTS, drift_by_speed

    if segments is None:
        return []
    drift = drift_by_speed(segments)
    columns = drift.speeds_mps, drift.num_segments, drift.t_rel_percent, drift.r_rel_deg_per_100m
    return [
        Line(f"{speed - 2:g} to {speed + 2:g} m/s ({count} segments)", float(t), UNITS[0], float(r), UNITS[1])
        for speed, count, t, r in zip(*columns, strict=True)
        if count >= KITTI_MIN_SEGMENTS
    ]


def _ate_lines(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> list[Line]:
    from delo_jax.metrics.ate import absolute_errors

    return [Line("ATE (RMSE after alignment)", absolute_errors(Ts_estimated, Ts_true).rmse_m, "m", np.nan, "")]


def _gap_lines(Ts_estimated: np.ndarray, Ts_true: np.ndarray, gaps: tuple[int, ...]) -> list[Line]:
    """Median and 95th percentile over every gap; of the default ones those that fit."""
    from delo_jax.metrics.ate import relative_errors

    lines = []
    for gap in gaps if gaps != GAPS else [gap for gap in gaps if gap < len(Ts_true)]:
        errors = relative_errors(Ts_estimated, Ts_true, gap=gap)
        t, r = 100 * errors.translation_m, np.rad2deg(errors.rotation_rad)
        for word, percentile in (("median", 50), ("p95", 95)):
            values = float(np.percentile(t, percentile)), float(np.percentile(r, percentile))
            lines.append(Line(f"gap {gap}, {word}", values[0], "cm", values[1], "deg", (2, 3)))
    return lines


def _write_json(path: Path, found: Compared, lines: list[Line]) -> None:
    rows = [
        {"what": line.what, line.translation_unit: line.translation} | ({line.rotation_unit: line.rotation} if line.rotation_unit else {})
        for line in lines
        if not np.isnan(line.translation)
    ]
    record = {"estimate": found.estimate.name, "truth": found.truth.name, "frame": found.frame, "frames": len(found.truth.Ts), "rows": rows}
    try:
        path.write_text(json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"--json {path}: expected a file to write to, got {error.strerror}; choose another") from error
