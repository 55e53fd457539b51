"""What may go wrong on a drive: none is lost, every bad frame says so, good frames stay `ok`.

Each event strikes the odometry on its local map in the middle of 40 scans of the drives of `running_odometry.py` (two of them as
measured by the turning sensor, two motion-compensated) and of `odo_00_056`, before its turn:

- sudden stop: from the speed it has to none in 0.2 s; swerve: 1.5 m aside in 1 s, nose first, which is 0.75 g, about what tyres hold
  (both on simulated drives only);
- five scans dropped; a duplicate: the last scan once more at the stamp of the next; noise: points uniform in a box;
  half a scan: the left half only;
- restart: off for 0.3 s, then 3 m farther on than constant velocity says, the sensor turned on its mount by 30 deg for good.

A frame is bad when its scan is noise, or its motion since the frame it was measured from is off by more than 0.3 m or 1 deg. A drive is
lost when from the scan before the event to the end it is off by more than 0.5 m + 1 % of the path, or 1 deg.

Run:     python experiments/outages.py --data TREE       (about 6 minutes on 2 cores)
Expect:  all bounds kept.
"""

from collections.abc import Callable
from typing import NamedTuple

import _harness
import jax
import numpy as np
from _harness import Row
from _peers import recorded
from rich.progress import Progress
from running_odometry import DRIVES

import delo_jax
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.metrics.registration import pose_errors
from delo_jax.model.delo import Model
from delo_jax.pipeline.motion_model import NANOSECOND
from delo_jax.sim import SENSORS, Motion, clear_path, draw_unit, make_motion, make_scene, simulate_drive, simulate_scan
from delo_jax.sim.drive import safe_speed
from delo_jax.sim.motion import SAMPLE_S

REAL = "odo_00_056"
ROLLING = ("mixed", "residential")  # drives delivered as measured
NUM_SCANS, EVENT, NUM_SPARE = 40, 20, 10  # scans, number of the first that the event touches, more of them where some are left out
PERIOD_S = FRAME_PERIOD_NS * NANOSECOND
STOP_S, SWERVE_S, SWERVE_M = 0.2, 1.0, 1.5
NUM_DROPPED, NUM_OFF = 5, 3  # scans dropped; periods of the outage before a restart
RESTART_M, RESTART_DEG = 3.0, 30.0
NOISE_BOX_M = np.array([[-50.0, -50.0, -2.0], [50.0, 50.0, 10.0]])
BAD_M, BAD_DEG = 0.3, 1.0
LOST_M, LOST_SHARE, LOST_DEG = 0.5, 0.01, 1.0
NUM_SHOWN = 8  # statuses from the event on
NONE = "nothing"


class Feed(NamedTuple):
    """A scan as the odometry gets it, and the truth that goes with it."""

    points: np.ndarray  # (n, 3) [m]
    times_s: np.ndarray | None
    stamp_ns: int
    T_world_lidar: np.ndarray  # where these points were measured
    noise: bool = False


Drive = list[Feed]


class Outcome(NamedTuple):
    """What became of a drive."""

    event: str
    drive: str
    bad: int
    hidden: int  # bad, yet `ok`
    good: int
    good_ok: int
    final_m: float  # from the scan before the event to the end
    final_deg: float
    allowed_m: float
    statuses: str  # first letters, from the event on

    @property
    def lost(self) -> bool:
        """Whether the drive was lost."""
        return not (self.final_m <= self.allowed_m and self.final_deg <= LOST_DEG)


def nothing(drive: Drive) -> Drive:
    """The drive as it is."""
    return drive


def dropped(drive: Drive) -> Drive:
    """Some scans never arrive."""
    return drive[:EVENT] + drive[EVENT + NUM_DROPPED :]


def duplicated(drive: Drive) -> Drive:
    """The last scan once more, at the stamp of the next."""
    return _replaced(drive, drive[EVENT - 1]._replace(stamp_ns=drive[EVENT].stamp_ns))


def noisy(drive: Drive) -> Drive:
    """A scan that shows nothing."""
    rng, shape = np.random.default_rng(0), drive[EVENT].points.shape
    points = rng.uniform(NOISE_BOX_M[0], NOISE_BOX_M[1], shape).astype(np.float32)
    return _replaced(drive, drive[EVENT]._replace(points=points, noise=True))


def half(drive: Drive) -> Drive:
    """A scan of the left side alone."""
    feed = drive[EVENT]
    left = feed.points[:, 1] > 0.0
    return _replaced(drive, feed._replace(points=feed.points[left], times_s=None if feed.times_s is None else feed.times_s[left]))


def restarted(drive: Drive) -> Drive:
    """Off for a while, then elsewhere than predicted, the sensor turned on its mount."""
    first = EVENT + NUM_OFF - 1  # the next scan by its stamp, and where constant velocity looks for it
    path_m = np.cumsum([0.0, *_steps_m(drive[first:])])
    later = int(np.argmin(np.abs(path_m - RESTART_M)))
    T_mount = se3.from_pose6(np.array([0.0, 0.0, np.radians(RESTART_DEG), 0.0, 0.0, 0.0]))
    after = []
    for feed in drive[first + later :]:
        points = (feed.points @ T_mount[:3, :3].T).astype(np.float32)
        stamp_ns, T_world_lidar = feed.stamp_ns - later * FRAME_PERIOD_NS, feed.T_world_lidar @ se3.inverse(T_mount)
        after.append(feed._replace(points=points, stamp_ns=stamp_ns, T_world_lidar=T_world_lidar))
    return drive[:EVENT] + after


def _replaced(drive: Drive, feed: Feed) -> Drive:
    return [*drive[:EVENT], feed, *drive[EVENT + 1 :]]


def _steps_m(drive: Drive) -> np.ndarray:
    return np.linalg.norm(np.diff([feed.T_world_lidar[:3, 3] for feed in drive], axis=0), axis=1)


def stopped(motion: Motion) -> Motion:
    """The same way, come to a stand."""
    begin_s = (EVENT - 1) * PERIOD_S
    rate = np.clip(1.0 - (motion.times - begin_s) / STOP_S, 0.0, 1.0)
    way_s = motion.start_s + np.cumsum(rate) * SAMPLE_S - rate[0] * SAMPLE_S

    def at(state: np.ndarray) -> np.ndarray:
        return np.interp(way_s, motion.times, state)

    states = (at(state) for state in (motion.heading, motion.roll, motion.pitch, motion.heave))
    return Motion(motion.start_s, np.stack([at(axis) for axis in motion.position.T], axis=1), *states)


def swerved(motion: Motion) -> Motion:
    """The same way, then beside it; the nose follows."""
    share = np.clip((motion.times - (EVENT - 1) * PERIOD_S) / SWERVE_S, 0.0, 1.0)
    aside = SWERVE_M * 0.5 * (1.0 - np.cos(np.pi * share))
    speed = np.linalg.norm(np.gradient(motion.position, SAMPLE_S, axis=0), axis=1)
    heading = motion.heading + np.arctan2(np.gradient(aside, SAMPLE_S), np.maximum(speed, 1.0))
    return motion._replace(position=motion.position + np.stack([np.zeros_like(aside), aside], axis=1), heading=heading)


ON_SCANS: dict[str, Callable[[Drive], Drive]] = {
    NONE: nothing,
    f"{NUM_DROPPED} scans dropped": dropped,
    "a duplicated scan": duplicated,
    "a scan of noise": noisy,
    "half a scan": half,
    f"restart {RESTART_M:g} m and {RESTART_DEG:g} deg off": restarted,
}
ON_MOTION: dict[str, Callable[[Motion], Motion]] = {"sudden stop": stopped, "swerve": swerved}


def simulated(kind: str, num_scans: int) -> Drive:
    """A drive with exact truth."""
    rolling = kind in ROLLING
    scans = simulate_drive(kind, DRIVES[kind], num_scans, rolling_shutter=rolling)
    return [Feed(scan.points, scan.times_s if rolling else None, k * FRAME_PERIOD_NS, scan.T_world_lidar) for k, scan in enumerate(scans)]


def simulated_motion(kind: str, num_scans: int, change: Callable[[Motion], Motion]) -> Drive:
    """A short drive of a changed motion."""
    seed, sensor, rolling = DRIVES[kind], SENSORS["hdl64e"], kind in ROLLING
    scene = make_scene(kind, seed)
    motion = change(make_motion(seed, num_scans * PERIOD_S, max_speed=min(30.0, safe_speed(scene.warp)), start_s=-PERIOD_S))
    scene, unit, key = clear_path(scene, motion), draw_unit(sensor, seed), jax.random.PRNGKey(seed)
    drive = []
    for k in range(num_scans):
        key_of_scan = jax.random.fold_in(key, k)
        scan = simulate_scan(scene, motion, k * PERIOD_S, sensor, key_of_scan, rolling_shutter=rolling, unit=unit)
        drive.append(Feed(scan.points, scan.times_s if rolling else None, k * FRAME_PERIOD_NS, scan.T_world_lidar))
    return drive


def judge(event: str, name: str, drive: Drive, params: Model) -> Outcome:
    """The odometry along a drive, and every one of its frames against the truth."""
    odometry = delo_jax.LidarOdometry(params, use_map=True)
    frames = [odometry.register(feed.points, feed.stamp_ns, feed.times_s) for feed in drive]
    Ts_true = np.stack([feed.T_world_lidar for feed in drive])
    motions = np.stack([frame.motion.T_target_source for frame in frames])
    since = np.array([frame.since for frame in frames])
    errors = pose_errors(motions, se3.inverse(Ts_true[since]) @ Ts_true)
    bad = (errors.translation_m > BAD_M) | (np.degrees(errors.rotation_rad) > BAD_DEG) | np.array([feed.noise for feed in drive])
    ok = np.array([frame.status == "ok" for frame in frames])
    before = EVENT - 1
    whole = pose_errors(
        (se3.inverse(frames[before].T_world_lidar) @ frames[-1].T_world_lidar)[None], (se3.inverse(Ts_true[before]) @ Ts_true[-1])[None]
    )
    return Outcome(
        event,
        name,
        bad=int(bad.sum()),
        hidden=int((bad & ok).sum()),
        good=int((~bad).sum()),
        good_ok=int((~bad & ok).sum()),
        final_m=float(whole.translation_m[0]),
        final_deg=float(np.degrees(whole.rotation_rad[0])),
        allowed_m=LOST_M + LOST_SHARE * float(_steps_m(drive[before:]).sum()),
        statuses="".join(frame.status[0] for frame in frames[EVENT : EVENT + NUM_SHOWN]),
    )


def report(outcomes: list[Outcome]) -> list[Row]:
    """The table, a line per event and drive, and three rows per event."""
    print(f"\nStatuses of the first {NUM_SHOWN} frames from the event on: ok, low_confidence, degenerate, rejected.\n")
    print("| event | drive | bad | bad, yet ok | good | good and ok | end: m | allowed | deg | statuses | |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|---|---|")
    for o in outcomes:
        end = f"{o.final_m:.2f} | {o.allowed_m:.2f} | {o.final_deg:.2f} | {o.statuses} | {'LOST' if o.lost else ''}"
        print(f"| {o.event} | {o.drive} | {o.bad} | {o.hidden} | {o.good} | {o.good_ok} | {end} |", flush=True)
    rows = []
    for event in dict.fromkeys(outcome.event for outcome in outcomes):
        own = [outcome for outcome in outcomes if outcome.event == event]
        good, good_ok = sum(o.good for o in own), sum(o.good_ok for o in own)
        rows += [
            Row(f"{event}: drives lost, of {len(own)}", float(sum(o.lost for o in own)), "", 0.0),
            Row(f"{event}: bad frames that are ok, of {sum(o.bad for o in own)}", float(sum(o.hidden for o in own)), "", 0.0),
            Row(f"{event}: of {good} good frames, ok", 100 * good_ok / good, "%", 98.0, True),
        ]
    return rows


def measure(params: Model, kinds: list[str], args, bar: Progress) -> list[Outcome]:
    """Every event on every drive."""
    outcomes, total = [], len(kinds) * (len(ON_SCANS) + len(ON_MOTION)) + len(ON_SCANS)
    task = bar.add_task("events", total=total)
    for kind in [*kinds, REAL]:
        if kind == REAL:
            read = recorded(args.data, REAL, NUM_SCANS + NUM_SPARE, bar)
            spare = [Feed(*sweep, T) for sweep, T in zip(read.sweeps, read.Ts_world_lidar, strict=True)]
        else:
            spare = simulated(kind, NUM_SCANS + NUM_SPARE)
        for event, strike in ON_SCANS.items():
            outcomes.append(judge(event, kind, strike(spare)[:NUM_SCANS], params))
            bar.advance(task)
        for event, change in ON_MOTION.items() if kind != REAL else ():
            outcomes.append(judge(event, kind, simulated_motion(kind, NUM_SCANS, change), params))
            bar.advance(task)
    return outcomes


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    parser = _harness.parser(__doc__, needs_data=True)
    parser.add_argument("--weights", default="delo-base", help="name or file")
    args = parser.parse_args(argv)
    with _harness.progress() as bar:
        outcomes = measure(delo_jax.load(args.weights), list(DRIVES)[: 1 if args.quick else None], args, bar)
    settings = {"weights": args.weights, "drives": DRIVES, "rolling": ROLLING, "scans": NUM_SCANS, "bad": (BAD_M, BAD_DEG)}
    return _harness.finish(report(outcomes), settings, args)


if __name__ == "__main__":
    _harness.run(main)
