"""The basin against a local map: how wrong a prediction may be for a scan to find its place.

A map of the scans so far at their true poses, the next scan, and a prediction that is wrong by 2 m and 10 deg, or by 3 m and 15 deg:
in a random horizontal direction, by a yaw of random sign, and by a little height (10 cm), roll and pitch (0.5 deg, one sigma each).
Back means within 15 cm and 0.3 deg of the truth. The drives of `running_odometry.py`, here without rolling shutter, and `odo_00_056`
against `poses_boresight`, up to its turn, where these labels are off: over all 86 scans, 18 % of those that start there leave them.
The last line of a table says how many scans end at the truth when they start there.

The fine stage: the odometry's recovery from the prediction alone. The coarse stage behind it: its whole recovery.
VGICP: small_gicp on points of 0.5 m and voxels of 1 m of the same scans. Classical: robust point to plane on our map, with no learned
step, at the gate of the pipeline and behind rounds on fewer points whose gate closes from 15 m. Times are those of the search;
preparing a scan is apart, for all alike.

Run:     python experiments/map_basin.py --data TREE       (about 5 minutes on 2 cores; needs '.[baselines]')
Expect:  all bounds kept.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import _harness
import jax
import numpy as np
import small_gicp
from _harness import Row
from _peers import Drive, Sweep, recorded
from rich.progress import Progress
from running_odometry import DRIVES

import delo_jax
from delo_jax import inference
from delo_jax.baselines.protocols import NUM_THREADS
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.metrics.registration import pose_errors
from delo_jax.model.delo import Model
from delo_jax.pipeline.local_map import LocalMap, Surroundings, surfaces_of
from delo_jax.pipeline.motion_model import NANOSECOND
from delo_jax.pipeline.scan_to_map import NUM_LEARNED_POINTS, REACH_M, RECOVERY_STEPS, MapTracker, Steps, register
from delo_jax.sim import simulate_drive

REAL, NUM_SCANS, NUM_REAL = "odo_00_056", 60, 40
FIRST_FRAME, NUM_FRAMES, NUM_STARTS = 5, 11, 4  # scans before the first trial, frames of a drive, starts of a frame
LEVELS = ((2.0, 10.0), (3.0, 15.0))  # m, deg
HEIGHT_M, TILT_DEG = 0.1, 0.5  # one sigma
BACK_M, BACK_DEG = 0.15, 0.3
PERIOD_S = FRAME_PERIOD_NS * NANOSECOND
CLOUD_M, VOXEL_M, VGICP_ROUNDS, VGICP_GATE_M = 0.5, 1.0, 60, 5.0  # more rounds and a wider gate than the defaults: better
NUM_ROUNDS = 15  # of the classical solver alone
CLOSING_GATE = ((6.0, 15.0),) * 6 + ((3.0, 10.0),) * 6 + ((1.0, 5.0),) * 6 + ((0.3, 2.0),) * 6  # scale and reach of each round [m]

FINE, COARSE, TRUTH = "fine stage", "with the coarse stage", "fine stage from the truth"
BOUNDS = {FINE: (90.0, 75.0), COARSE: (98.0, 98.0)}  # % back at each level


class Scene(NamedTuple):
    """A scan that is to find its place, and the world in the form that each method wants."""

    params: Model
    scan: inference.PreparedScan
    previous: inference.PreparedScan
    T_world_previous: np.ndarray
    local_map: LocalMap
    tracker: MapTracker
    cloud: small_gicp.PointCloud
    voxel_map: small_gicp.GaussianVoxelMap


class Trial(NamedTuple):
    """One search."""

    drive: str
    level: int
    method: str
    back: bool
    seconds: float


def fine(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    """The odometry's recovery without the coarse stage: learned steps from two subsets of points, each with its classical end."""
    found = scene.tracker.locate(scene.scan, scene.T_world_previous, [_seen_from_previous(scene, T_world_start)], PERIOD_S, recovering=True)
    return scene.T_world_previous @ found.motion.T_target_source


def _seen_from_previous(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    return se3.inverse(scene.T_world_previous) @ T_world_start


def recover(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    """What the odometry does: the network aligns the scan with the last one too, and the map judges both."""
    T_previous_start = _seen_from_previous(scene, T_world_start)
    pair = inference.align(scene.params, scene.previous, scene.scan, se3.inverse(T_previous_start))
    guesses = [T_previous_start, se3.inverse(pair.T_target_source)]
    found = scene.tracker.locate(scene.scan, scene.T_world_previous, guesses, PERIOD_S, recovering=True)
    return scene.T_world_previous @ found.motion.T_target_source


def vgicp(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    """small_gicp, scan to Gaussian voxels."""
    found = small_gicp.align(
        scene.voxel_map,
        scene.cloud,
        T_world_start,
        max_correspondence_distance=VGICP_GATE_M,
        max_iterations=VGICP_ROUNDS,
        num_threads=NUM_THREADS,
    )
    return np.asarray(found.T_target_source)


def classical(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    """Robust point to plane on the same map at the gate of the pipeline, more rounds."""
    near = Surroundings(scene.local_map, T_world_start, REACH_M)
    fix = register(scene.params, scene.scan, near, np.eye(4), num_learned=0, num_rounds=NUM_ROUNDS)
    return T_world_start @ fix.T_start_lidar


def closing(scene: Scene, T_world_start: np.ndarray) -> np.ndarray:
    """The same behind rounds on fewer points whose gate closes."""
    near, source = Surroundings(scene.local_map, T_world_start, REACH_M), surfaces_of(scene.scan.scan, slice(0, NUM_LEARNED_POINTS))
    T = np.eye(4, dtype=np.float32)
    for scale_m, reach_m in CLOSING_GATE:
        matched = near.matches(source, T)
        rows = source.points, source.normals, source.mask, matched.points, matched.normals
        T = np.asarray(inference.robust_steps(*rows, T, scale_m=scale_m, reach_m=reach_m, num_steps=2).T_target_source)
    fix = register(scene.params, scene.scan, near, T.astype(np.float64), num_learned=0, num_rounds=2)
    return T_world_start @ fix.T_start_lidar


METHODS: dict[str, Callable[[Scene, np.ndarray], np.ndarray]] = {
    FINE: fine,
    COARSE: recover,
    "VGICP": vgicp,
    "classical": classical,
    "classical, closing gate": closing,
}


def wrong_by(level: int, rng: np.random.Generator) -> np.ndarray:
    """T_true_start: a wrong prediction, seen from the truth."""
    distance_m, yaw_deg = LEVELS[level]
    direction = rng.uniform(0.0, 2.0 * np.pi)
    roll, pitch = np.radians(TILT_DEG) * rng.normal(size=2)
    yaw, height = np.radians(yaw_deg) * rng.choice([-1.0, 1.0]), HEIGHT_M * rng.normal()
    return se3.from_pose6(np.array([roll, pitch, yaw, distance_m * np.cos(direction), distance_m * np.sin(direction), height]))


def simulated(kind: str, num_scans: int) -> Drive:
    """An HDL-64E's motion-compensated scans, with exact truth."""
    scans = list(simulate_drive(kind, DRIVES[kind], num_scans))
    sweeps = [Sweep(scan.points, None, k * FRAME_PERIOD_NS) for k, scan in enumerate(scans)]
    return Drive(kind, sweeps, np.stack([scan.T_world_lidar for scan in scans]))


def measure(drive: Drive, params: Model, num_frames: int, bar: Progress) -> list[Trial]:
    """Every method from every start, at frames spread over the drive."""
    frames = np.linspace(FIRST_FRAME, len(drive.sweeps) - 1, num_frames).astype(int)
    local_map, tracker, voxel_map = LocalMap(), MapTracker(params, Steps()), small_gicp.GaussianVoxelMap(VOXEL_M)
    trials: list[Trial] = []
    last: tuple[inference.PreparedScan, np.ndarray] | None = None
    for k, (sweep, T) in enumerate(bar.track(list(zip(drive.sweeps, drive.Ts_world_lidar, strict=True)), description=drive.name)):
        scan = inference.prepare(params, sweep.points)
        cloud, _ = small_gicp.preprocess_points(sweep.points.astype(np.float64), downsampling_resolution=CLOUD_M, num_threads=NUM_THREADS)
        jax.block_until_ready(scan.encoding)
        if last is not None and k in frames:
            trials += searches(drive.name, Scene(params, scan, *last, local_map, tracker, cloud, voxel_map), T, k)
        local_map.insert(surfaces_of(scan.scan), T)
        local_map.prune(T)
        tracker.insert(scan, T)
        voxel_map.insert(cloud, T)
        last = scan, T
    return trials


def searches(name: str, scene: Scene, T_world_lidar: np.ndarray, frame: int) -> list[Trial]:
    """The trials of one frame; methods take turns at who is first."""
    trials, methods = [], list(METHODS.items())
    for level in range(len(LEVELS)):
        rng = np.random.default_rng([frame, level])
        for number in range(NUM_STARTS):
            start = T_world_lidar @ wrong_by(level, rng)
            for method, search in methods[number:] + methods[:number]:
                begin = time.perf_counter()
                found = search(scene, start)
                seconds = time.perf_counter() - begin
                trials.append(Trial(name, level, method, is_back(found, T_world_lidar), seconds))
        trials.append(Trial(name, level, TRUTH, is_back(fine(scene, T_world_lidar), T_world_lidar), np.nan))
    return trials


def is_back(T_world_lidar: np.ndarray, T_true: np.ndarray) -> bool:
    """Whether a pose is the true one, as far as it matters."""
    if not np.isfinite(T_world_lidar).all():
        return False
    errors = pose_errors(T_world_lidar[None], T_true[None])
    return bool(errors.translation_m[0] < BACK_M and np.degrees(errors.rotation_rad[0]) < BACK_DEG)


def back_percent(trials: list[Trial]) -> float:
    """Share of the searches that ended at the truth."""
    return 100 * float(np.mean([trial.back for trial in trials]))


def report(trials: list[Trial], level: int) -> list[Row]:
    """The table of one level, a line per method, and its rows."""
    distance_m, yaw_deg = LEVELS[level]
    drives = list(dict.fromkeys(trial.drive for trial in trials))
    print(f"\n## Back from {distance_m:g} m and {yaw_deg:g} deg, in percent\n")
    print(f"| method | {' | '.join(drives)} | all | p50 ms | p95 ms |\n|---|{'---:|' * (len(drives) + 3)}")
    rows = []
    for method in (*METHODS, TRUTH):
        own = [trial for trial in trials if trial.level == level and trial.method == method]
        cells = " | ".join(f"{back_percent([trial for trial in own if trial.drive == name]):.0f}" for name in drives)
        p50_ms, p95_ms = 1e3 * np.percentile([trial.seconds for trial in own], (50, 95))
        clock = " | " if method == TRUTH else f"{p50_ms:.0f} | {p95_ms:.0f}"
        print(f"| {method} | {cells} | {back_percent(own):.1f} | {clock} |", flush=True)
        if method != TRUTH:
            bound = BOUNDS[method][level] if method in BOUNDS else None
            what = f"{method}, {distance_m:g} m and {yaw_deg:g} deg"
            rows += [Row(f"{what}: back, of {len(own)}", back_percent(own), "%", bound, True), Row(f"{what}: p50", float(p50_ms), "ms")]
    return rows


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    parser = _harness.parser(__doc__, needs_data=True)
    parser.add_argument("--weights", default="delo-base", help="name or file")
    args = parser.parse_args(argv)
    params = delo_jax.load(args.weights)
    num_scans, num_real, num_frames = (12, 12, 2) if args.quick else (NUM_SCANS, NUM_REAL, NUM_FRAMES)
    with _harness.progress() as bar:
        drives = [simulated(kind, num_scans) for kind in bar.track(DRIVES, description="simulating")]
        drives.append(recorded(args.data, REAL, num_real, bar))
        trials = [trial for drive in drives for trial in measure(drive, params, num_frames, bar)]
    rows = [row for level in range(len(LEVELS)) for row in report(trials, level)]
    settings = {"weights": args.weights, "drives": DRIVES, "levels": LEVELS, "back": (BACK_M, BACK_DEG), "steps": RECOVERY_STEPS}
    return _harness.finish(rows, settings, args)


if __name__ == "__main__":
    _harness.run(main)
