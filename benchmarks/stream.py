"""What a stream costs besides its frames: import, start, functions that are compiled on the way, memory.

- Import: `import delo_jax` in a fresh interpreter, and which large packages it brings.
- Start: `delo run` in a fresh process until the first pose is in poses_kitti.txt, with an empty compilation cache and with what that
  left there, on scans of a simulated HDL-64E.
- Odd sizes: one `LidarOdometry`, compiled beforehand as `delo run` does it, along a simulated drive (450 columns, as measured) whose
  scans lose 0 to 90 % of their points; one is empty, one is noise, one has no times, and five never arrive: the odometry recovers on
  the way. JAX's own events say what is traced and compiled, and when.
- Memory: the same over a longer drive, nothing lost. Both streams are tracked by a process that does nothing else.

Run:     python benchmarks/stream.py [--quick]        (about 5 minutes on 2 cores)

Exits 1 when a bound is missed.
"""

import json
import multiprocessing
import os
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from rich.progress import Progress

sys.path.append(str(Path(__file__).parents[1] / "experiments"))

import _harness
from _harness import Row

import delo_jax
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.sim import SENSORS, simulate_drive
from delo_jax.sim.drive import DRIVE_SEED

KIND, SEED, WEIGHTS = "mixed", 7, "delo-base"
LARGE = ("gtsam", "matplotlib", "orbax", "grain")  # packages that a stream of poses needs not
EVENTS = {"/jax/core/compile/jaxpr_trace_duration": "trace", "/jax/core/compile/backend_compile_duration": "compile"}
NOISE_BOX_M = np.array([[-50.0, -50.0, -2.0], [50.0, 50.0, 10.0]])
MOST_LOST = 0.9  # share of a scan's points
NUM_DROPPED = 5
WINDOW = 50  # scans whose largest resident memory counts
POLL_S = 0.005


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much to measure."""

    num_repeats: int = 3
    """Imports of which the best, starts of which the median counts."""
    num_start_scans: int = 10
    num_odd: int = 500
    num_long: int = 2000
    num_settled: int = 200
    """Scans after which memory should not grow any more."""


QUICK = Settings(num_repeats=1, num_start_scans=3, num_odd=30, num_long=40, num_settled=20)


class Sweep(NamedTuple):
    """A scan as the odometry gets it."""

    points: np.ndarray  # (n, 3) [m]
    times_s: np.ndarray | None
    stamp_ns: int


class Built(NamedTuple):
    """A function that JAX traced or compiled."""

    scan: int  # during which; -1: before the first
    step: str  # a value of `EVENTS`
    function: str
    seconds: float


class Watched(NamedTuple):
    """What a stream cost."""

    built: list[Built]
    resident_mb: list[float]  # after every scan
    kept_mb: list[float]  # what the trajectory holds of all frames, and of those before memory has settled
    sizes: list[int]  # points of every scan
    statuses: list[str]

    def on_the_way(self) -> list[Built]:
        """What was built while a scan waited."""
        return [one for one in self.built if one.scan >= 0]

    def growth_mb(self, num_settled: int) -> float:
        """Of resident memory since so many scans, beyond the poses kept; peaks over a few scans."""
        before = max(self.resident_mb[max(num_settled - WINDOW, 0) : num_settled])
        return max(self.resident_mb[num_settled:][-WINDOW:]) - before - (self.kept_mb[0] - self.kept_mb[1])


class Start(NamedTuple):
    """A start of `delo run`."""

    first_pose_s: float
    compile_s: float


def import_rows(num_repeats: int) -> list[Row]:
    """Time of an import and what it brings, of the package alone and of the names that make an odometry."""
    code = """if True:
        import json, sys, time
        begin = time.perf_counter()
        {statement}
        seconds = time.perf_counter() - begin
        print(json.dumps([seconds, [name for name in {large!r} if name in sys.modules]]))
    """
    rows = []
    for statement, bound, num_allowed in (
        ("import delo_jax", 1.0, 0.0),
        ("from delo_jax import LidarOdometry, load", None, None),
    ):
        command = [sys.executable, "-c", code.format(statement=statement, large=LARGE)]
        answers = [json.loads(subprocess.run(command, check=True, capture_output=True).stdout) for _ in range(num_repeats)]
        brought = {name for _, names in answers for name in names}
        rows += [
            Row(f"`{statement}`, best of {num_repeats}", min(seconds for seconds, _ in answers), "s", bound),
            Row(f"`{statement}`: of {', '.join(LARGE)}, imported", float(len(brought)), "", num_allowed),
        ]
    return rows


def started(tree: Path, folder: Path, cache: Path) -> Start:
    """A fresh `delo run`, which keeps what it compiles in `cache`."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    command = [sys.executable, "-m", "delo_jax", "run", str(tree), "--out", str(folder), "--weights", WEIGHTS]
    poses, log, first_s = folder / "poses_kitti.txt", folder.with_suffix(".log"), float("nan")
    with log.open("wb") as file:
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=file, stderr=file, env=environment | {"XDG_CACHE_HOME": str(cache)})
        while process.poll() is None and np.isnan(first_s):
            time.sleep(POLL_S)
            if poses.exists() and b"\n" in poses.read_bytes():
                first_s = time.perf_counter() - begin
        code = process.wait()
    if code or np.isnan(first_s):
        sys.exit(f"{' '.join(command)}: expected poses, got exit code {code}: {' '.join(log.read_text().splitlines()[-1:])}")
    return Start(first_s, float(json.loads((folder / "run.json").read_text())["compile_s"]))


def start_rows(work: Path, settings: Settings, bar: Progress) -> list[Row]:
    """The first start, whose cache is empty, and the second one."""
    length = "--num-scans", str(settings.num_start_scans)
    command = [sys.executable, "-m", "delo_jax", "simulate", str(work / "tree"), "--drive", KIND, *length]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    task = bar.add_task("starts of delo run", total=2 * settings.num_repeats)
    found: dict[str, list[Start]] = {"empty": [], "warm": []}
    for number in range(settings.num_repeats):
        for cache, starts in found.items():
            starts.append(started(work / "tree", work / f"{cache}-{number}", work / f"cache-{number}"))
            bar.advance(task)
    rows = []
    for (cache, starts), bound in zip(found.items(), (20.0, 5.0), strict=True):
        rows += [
            Row(f"`delo run` to the first pose, {cache} cache", statistics.median(one.first_pose_s for one in starts), "s", bound),
            Row(f"of which compiling, {cache} cache", statistics.median(one.compile_s for one in starts), "s"),
        ]
    return rows


def drive(num_scans: int) -> Iterator[Sweep]:
    """A long drive with few columns, as measured by the moving sensor."""
    sensor = replace(SENSORS["hdl64e"], num_columns=450)
    for k, scan in enumerate(simulate_drive(KIND, DRIVE_SEED + SEED, num_scans, sensor, rolling_shutter=True)):
        yield Sweep(scan.points, scan.times_s, k * FRAME_PERIOD_NS)


def odd_sizes(sweeps: Iterator[Sweep], num_scans: int) -> Iterator[Sweep]:
    """So many sweeps that lose points at random; a fifth of the way each: one of none, of noise, without times, and five left out."""
    rng, fifth, number = np.random.default_rng(0), num_scans // 5, 0
    for k, sweep in enumerate(sweeps):
        if 4 * fifth <= k < 4 * fifth + NUM_DROPPED:
            continue
        kept = rng.uniform(size=len(sweep.points)) >= rng.uniform(0.0, MOST_LOST)
        points, times_s = sweep.points[kept], None if sweep.times_s is None else sweep.times_s[kept]
        if k == fifth:
            points, times_s = points[:0], None if times_s is None else times_s[:0]
        elif k == 2 * fifth:
            points = rng.uniform(NOISE_BOX_M[0], NOISE_BOX_M[1], points.shape).astype(np.float32)
        elif k == 3 * fifth:
            times_s = None
        yield Sweep(points, times_s, sweep.stamp_ns)
        number += 1
        if number == num_scans:
            return


def watched(sweeps: Iterator[Sweep], what: str, settings: Settings, bar: Progress, total: int) -> Watched:
    """Sweeps tracked in a process of its own: the simulator's memory and compilations are not the odometry's."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_track, args=(theirs, settings.num_settled), daemon=True)
    process.start()
    theirs.close()
    task = bar.add_task(what, total=total)
    try:
        for sweep in sweeps:
            ours.send(sweep)
            bar.advance(task)
        ours.send(None)
        return ours.recv()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        sys.exit(f"{what}: expected a tracked stream, got the end of its process; see its message above")
    finally:
        ours.close()
        process.join()


def _track(connection: Connection, num_settled: int) -> None:
    """Tracks every sweep that comes; after the last, None, sends what it cost."""
    seen = Watched([], [], [], [], [])
    number = -1

    def note(event: str, duration_secs: float, **words: str | int) -> None:
        if event in EVENTS:
            seen.built.append(Built(number, EVENTS[event], str(words.get("fun_name", "?")), duration_secs))

    odometry = delo_jax.LidarOdometry(delo_jax.load(WEIGHTS))
    jax.monitoring.register_event_duration_secs_listener(note)
    odometry.compile()
    while (sweep := connection.recv()) is not None:
        number += 1
        frame = odometry.register(sweep.points, sweep.stamp_ns, sweep.times_s)
        seen.sizes.append(len(sweep.points))
        seen.statuses.append(frame.status)
        seen.resident_mb.append(_resident_mb())
    records = odometry.trajectory().records  # in memory they are larger: what is taken off the growth is less than they need
    seen.kept_mb.extend(len(pickle.dumps(part)) / 1e6 for part in (records, records[:num_settled]))
    connection.send(seen)


def _resident_mb() -> float:
    """Resident memory of this process [MB]; Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def odd_rows(seen: Watched) -> list[Row]:
    """What was built on the way; the table says what, and when."""
    print("\n| function | step | when | s |\n|---|---|---|---:|")
    for one in seen.built:
        print(f"| {one.function} | {one.step} | {'before the first scan' if one.scan < 0 else f'scan {one.scan}'} | {one.seconds:.3f} |")
    name, compiled = f"{len(seen.sizes)} scans of odd sizes", [one for one in seen.built if one.scan < 0 and one.step == "compile"]
    return [
        Row(f"{name}: fewest points, other than none", float(min(size for size in seen.sizes if size)), ""),
        Row(f"{name}: most points", float(max(seen.sizes)), ""),
        Row(f"{name}: rejected", float(seen.statuses.count("rejected")), ""),
        Row(f"{name}: compiled before the first", float(len(compiled)), "", 1.0, True),  # a listener that hears nothing proves nothing
        Row(f"{name}: traced or compiled on the way", float(len(seen.on_the_way())), "", 0.0),
    ]


def memory_rows(seen: Watched, num_settled: int) -> list[Row]:
    """Growth once the map is full."""
    after = f"after the first {num_settled} of {len(seen.resident_mb)} scans"
    return [
        Row(f"resident memory growth {after}, beyond the poses", seen.growth_mb(num_settled), "MB", 20.0),
        Row(f"poses kept {after}", seen.kept_mb[0] - seen.kept_mb[1], "MB"),
        Row(f"resident memory, largest of {len(seen.resident_mb)} scans", max(seen.resident_mb), "MB"),
        Row(f"traced or compiled in {len(seen.resident_mb)} scans", float(len(seen.on_the_way())), "", 0.0),
    ]


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    args = _harness.parser(__doc__, needs_data=False).parse_args(argv)
    settings = QUICK if args.quick else Settings()
    rows = import_rows(settings.num_repeats)
    with tempfile.TemporaryDirectory() as work, _harness.progress() as bar:
        rows += start_rows(Path(work), settings, bar)
        sweeps = odd_sizes(drive(settings.num_odd + NUM_DROPPED), settings.num_odd)
        odd = watched(sweeps, "scans of odd sizes", settings, bar, settings.num_odd)
        long = watched(drive(settings.num_long), "scans of a long drive", settings, bar, settings.num_long)
    rows += [*odd_rows(odd), *memory_rows(long, settings.num_settled)]
    return _harness.finish(rows, asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
