"""Two real scans in, a pose out, from the identity and without a motion prior, at frame gaps 1, 2, 3, 5 and 10.

Every pair (k, k + gap) of the validation sequences by stateless calls of `odometry(params, src, tgt)`, beside the identity,
constant velocity (GICP's own last estimate, extrapolated), full-scan GICP from the identity (gates of 2 m and 4 m) and, as
the floor that the truth's noise sets, full-scan GICP started at the truth. Against `poses_boresight` (the bounds) and `poses`.
Then the other sensors with the same weights, and the train sequence with the right-angle turn.

Run:     python experiments/no_prior_registration.py --data TREE       (about 6 minutes on 2 cores)
Expect:  all bounds kept; gap 10 is printed without a bound.
"""

from pathlib import Path
from typing import NamedTuple

import _harness
import numpy as np
from _harness import Row
from rich.progress import Progress

import delo_jax
from delo_jax.baselines.gicp import Gicp
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.geometry import se3
from delo_jax.metrics.registration import pose_errors

GAPS = (1, 2, 3, 5, 10)
LOST_M, LOST_DEG = 0.5, 2.0
GAPS_OF_TRAIN = (1, 2, 3)
ANY = float("inf")
GATES_M = (1.0, 2.0, 4.0)  # of GICP
BOUNDS = {  # sequence -> gap -> median cm, median deg, lost %
    "raw_0926_0013": {1: (2.5, 0.06, 0.0), 2: (3.5, 0.08, 0.0), 3: (5.0, 0.09, 0.0), 5: (7.0, 0.12, 1.0)},
    "odo_04_000": {1: (2.0, 0.06, 0.0), 2: (2.5, 0.07, 0.0), 3: (3.0, 0.09, 0.0), 5: (3.5, 0.13, 1.0)},
    "odo_00_056": {gap: (ANY, ANY, 0.0) for gap in GAPS_OF_TRAIN},  # train sequence, right-angle turn
}


class Errors(NamedTuple):
    """Errors of n pairs."""

    cm: np.ndarray
    deg: np.ndarray
    components_cm: np.ndarray  # (n, 3) forward, lateral, vertical
    lost: np.ndarray  # bool

    @classmethod
    def of(cls, estimated: list[np.ndarray], true: np.ndarray) -> "Errors":
        """Errors of T_target_source, expressed in the frame of the source."""
        errors = pose_errors(np.array(estimated), true)
        deg = np.degrees(errors.rotation_rad)
        lost = (errors.translation_m > LOST_M) | (deg > LOST_DEG)
        return cls(100 * errors.translation_m, deg, 100 * errors.components_m, lost)

    def cells(self) -> str:
        """Median / p95 / max in cm and deg, share lost, median per direction."""
        lengths = " / ".join(f"{value:.1f}" for value in (np.median(self.cm), np.percentile(self.cm, 95), self.cm.max()))
        angles = " / ".join(f"{value:.3f}" for value in (np.median(self.deg), np.percentile(self.deg, 95), self.deg.max()))
        directions = " / ".join(f"{value:.1f}" for value in np.median(np.abs(self.components_cm), axis=0))
        return f"{lengths} | {angles} | {100 * self.lost.mean():.1f} | {directions}"


class Gicps:
    """Full-scan GICP with several gates; clouds are prepared once for all of them."""

    def __init__(self, scans: list[np.ndarray], bar: Progress):
        self._methods = {gate_m: Gicp(gate_m=gate_m) for gate_m in GATES_M}
        self._clouds = [self._methods[GATES_M[0]].prepare(scan) for scan in bar.track(scans, description="GICP's clouds")]

    def align(self, source: int, target: int, T_init: np.ndarray, gate_m: float) -> np.ndarray:
        """T_target_source from a start, with correspondences up to `gate_m`."""
        return self._methods[gate_m].align(self._clouds[source], self._clouds[target], T_init).T_target_source


def relative(Ts_world_lidar: np.ndarray, gap: int, count: int) -> np.ndarray:
    """True T_target_source of the pairs (k, k + gap), k < count."""
    return se3.inverse(Ts_world_lidar[gap : gap + count]) @ Ts_world_lidar[:count]


def measure_gap(gap, scans, gicp, truth, motions, params, bar):
    """Estimates of every method at one gap: name -> list of T_target_source; and the statuses of ours."""
    count = len(scans) - gap
    true = relative(truth, gap, count)
    names = "identity", "constant velocity", "GICP, 2 m gate", "GICP, 4 m gate", "ours", "floor: GICP from truth"
    poses: dict[str, list[np.ndarray]] = {name: [] for name in names}
    statuses = []
    task = bar.add_task(f"gap {gap}", total=count)
    for k in range(count):
        estimate = delo_jax.odometry(params, scans[k], scans[k + gap])
        previous = motions[k - 1] if k else np.eye(4)
        answers = (
            np.eye(4),
            np.linalg.matrix_power(previous, gap),
            gicp.align(k, k + gap, np.eye(4), 2.0),
            gicp.align(k, k + gap, np.eye(4), 4.0),
            estimate.T_target_source,
            gicp.align(k, k + gap, true[k], 1.0),
        )
        for name, T in zip(names, answers, strict=True):
            poses[name].append(T)
        statuses.append(estimate.status)
        bar.advance(task)
    return poses, np.array(statuses)


def gicp_motions(gicp: Gicps, count: int, bar: Progress) -> list[np.ndarray]:
    """GICP's own motions T_current_previous, frame by frame, each started from the one before."""
    motions = [gicp.align(0, 1, np.eye(4), 4.0)]
    for k in bar.track(range(1, count - 1), description="GICP's motions"):
        motions.append(gicp.align(k, k + 1, motions[-1], 2.0))
    return motions


def load(data: Path, name: str):
    """Scans (elevation-corrected) and the two truths, T_first_lidar, of a sequence."""
    dataset = delo_jax.open_dataset(data / "sequences" / name)
    T_cam_lidar = _harness.needed(dataset.T_cam_lidar, "Tr in calib.txt")
    poses = [camera_to_lidar(read_kitti_poses(data / folder / f"{name}.txt"), T_cam_lidar) for folder in ("poses_boresight", "poses")]
    print(f"\n## {name}: {len(dataset)} scans, elevation + {dataset.elevation_correction_deg:g} deg, no de-skew\n")
    return [dataset[index].points for index in range(len(dataset))], *poses


def sequence(data: Path, name: str, params, bar, *, gaps, bounds, quick: bool) -> list[Row]:
    """Table and rows of one sequence."""
    scans, boresight, raw = load(data, name)
    scans = scans[:16] if quick else scans
    gicp, rows, judged = Gicps(scans, bar), [], []
    motions = gicp_motions(gicp, len(scans), bar)
    print("| gap | method | against | cm: median / p95 / max | deg: median / p95 / max | lost % | cm: forward / lateral / vertical |")
    print("|---:|---|---|---|---|---:|---|")
    for gap in gaps:
        poses, statuses = measure_gap(gap, scans, gicp, boresight, motions, params, bar)
        count = len(statuses)
        references = {
            "boresight": relative(boresight, gap, count),
            "poses": relative(raw, gap, count),
            "GICP from truth": np.array(poses["floor: GICP from truth"]),
        }
        for method, estimated in poses.items():
            for reference, true in references.items():
                errors = Errors.of(estimated, true)
                if reference != "GICP from truth" or method == "ours":
                    print(f"| {gap} | {method} | {reference} | {errors.cells()} |", flush=True)
                if reference == "boresight" and method == "ours":
                    judged.append((gap, errors, statuses))
    for gap, errors, statuses in judged:
        rows += status_rows(name, gap, errors, statuses)
        if gap in bounds:
            cm, deg, lost = bounds[gap]
            if cm < ANY:
                rows.append(Row(f"{name} gap {gap} median", float(np.median(errors.cm)), "cm", cm))
                rows.append(Row(f"{name} gap {gap} median", float(np.median(errors.deg)), "deg", deg))
            rows.append(Row(f"{name} gap {gap} lost", 100 * float(errors.lost.mean()), "%", lost))
    return rows


def status_rows(name: str, gap: int, errors: Errors, statuses: np.ndarray) -> list[Row]:
    """What the status said: of lost pairs at wide gaps, of good pairs at narrow ones."""
    rows = []
    if gap >= 5:
        caught = 100 * float((statuses[errors.lost] != "ok").mean()) if errors.lost.any() else 100.0
        rows.append(Row(f"{name} gap {gap}: of {errors.lost.sum()} lost pairs, not ok (100 when none is lost)", caught, "%", 90.0, True))
    if gap <= 3:
        good = 100 * float((statuses[~errors.lost] == "ok").mean())
        rows.append(Row(f"{name} gap {gap}: of {(~errors.lost).sum()} good pairs, ok", good, "%", 98.0, True))
    return rows


def other_sensors(data: Path, params) -> list[Row]:
    """The Ouster sweeps and the HDL-32 pair, same weights, no special settings."""
    rows = []
    ouster = delo_jax.open_dataset(data / "ouster_street")
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3] = np.loadtxt(data / "ouster_street" / "poses.txt").reshape(-1, 3, 4)
    pairs = [(f"ouster_street {k} to {k + 1}", ouster[k].points, ouster[k + 1].points, relative(poses, 1, 2)[k], 0.3) for k in range(2)]
    source, target = (delo_jax.read_scan(data / "pairs" / f"hdl32_{role}.bin").points for role in ("source", "target"))
    pairs.append(("hdl32", source, target, np.loadtxt(data / "pairs" / "hdl32_T_target_source.txt"), 0.5))
    for name, source, target, true, bound_deg in pairs:
        estimate = delo_jax.odometry(params, source, target)
        errors = Errors.of([estimate.T_target_source], true[None])
        rows.append(Row(f"{name} ({estimate.status})", float(errors.cm[0]), "cm", 5.0))
        rows.append(Row(f"{name} ({estimate.status})", float(errors.deg[0]), "deg", bound_deg))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    parser = _harness.parser(__doc__, needs_data=True)
    parser.add_argument("--weights", default="delo-base", help="name or file")
    parser.add_argument("--sequences", nargs="*", default=list(BOUNDS), help="of the data tree; with bounds where there are any")
    args = parser.parse_args(argv)
    params = delo_jax.load(args.weights)
    rows = []
    with _harness.progress() as bar:
        for name in args.sequences:
            bounds = BOUNDS.get(name, {})
            gaps = GAPS_OF_TRAIN if set(bounds) == set(GAPS_OF_TRAIN) else GAPS
            rows += sequence(args.data, name, params, bar, gaps=gaps, bounds=bounds, quick=args.quick)
    rows += other_sensors(args.data, params)
    return _harness.finish(rows, {"weights": args.weights, "gaps": GAPS, "lost": (LOST_M, LOST_DEG)}, args)


if __name__ == "__main__":
    _harness.run(main)
