"""Sequences, and what every method makes of them: one pass over the scans for all methods that are not known yet, kept by content."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from _peers import Sweep, recorded
from _routes import official
from rich.progress import Progress

import delo_jax
from delo_jax.baselines.protocols import PairMethod
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.pipeline.lidar_odometry import Frame
from delo_jax.sim import simulate_route
from delo_jax.train.worlds import SIMULATOR, write_arrays

GAPS = (1, 2, 3, 5)
NUM_PAIRS = 60  # of a sequence and gap, at even distances
ROUTE_SEED = 770_000  # of the world of sequence 00
KINDS = {  # of the worlds beside KITTI's routes
    "00": "residential",
    "01": "road",
    "02": "mixed",
    "03": "open",
    "04": "road",
    "05": "residential",
    "06": "urban",
    "07": "urban",
    "08": "residential",
    "09": "open",
    "10": "mixed",
}
WHOLE, EXCERPT = ("04", "07", "10"), 300
PACKAGE = Path(delo_jax.__file__).parent
OTHERS = (
    "geometry",
    "data",
    "preprocess.py",
    "baselines",
    *(f"pipeline/{name}.py" for name in ("baseline_odometry", "motion_model", "stamps")),
)
OWN = (
    *("geometry", "ops", "model", "uncertainty", "data", "preprocess.py", "inference.py"),
    *(f"pipeline/{name}.py" for name in ("lidar_odometry", "local_map", "motion_model", "scan_to_map", "stamps")),
)  # parts of the package that results depend on
RENDERING = ("sim",)


class Poses(NamedTuple):
    """What an odometry made of a sequence."""

    Ts_world_lidar: np.ndarray  # (n, 4, 4)
    seconds: np.ndarray  # (n,) a scan, reading and rendering apart
    ok: np.ndarray  # (n,) whether the status says so; true where a method has none


class Pairs(NamedTuple):
    """What a pair method made of a sequence, from the identity, pair by pair."""

    errors: np.ndarray  # (n, 6) log(T_estimated^-1 T_true)
    gaps: np.ndarray  # (n,)
    seconds: np.ndarray  # (n,)


class Results(NamedTuple):
    """Of one sequence, by name of the method."""

    Ts_world_lidar: np.ndarray  # true
    poses: dict[str, Poses]
    pairs: dict[str, Pairs]


class Sequence(NamedTuple):
    """Scans with poses, made or read one by one."""

    name: str
    num_scans: int
    key: str  # changes with what the scans depend on
    scans: Callable[[], Iterator[tuple[Sweep, np.ndarray]]]


class Odometry(Protocol):
    """`LidarOdometry`, or another method in its place."""

    def register(self, points: np.ndarray, stamp_ns: int | None = None, times_s: np.ndarray | None = None) -> Frame:
        """The next frame."""
        ...


class Entry(NamedTuple):
    """A method, made anew for every sequence."""

    version: str  # changes with what its results depend on
    odometry: Callable[[], Odometry] | None
    pair: Callable[[], PairMethod] | None


def source_hash(parts: tuple[str, ...]) -> str:
    """Of the files of some parts of the package."""
    digest = hashlib.sha256()
    for part in parts:
        root = PACKAGE / part
        for path in [root] if root.is_file() else sorted(p for p in root.rglob("*") if p.is_file() and p.suffix != ".pyc"):
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def simulated(data: Path, number: str, *, num_scans: int | None) -> Sequence:
    """A drive along an official sequence, as measured by a turning sensor; whole, or its first frames."""
    Ts = se3.orthonormal(official(data, number))[:num_scans]
    kind, seed = KINDS[number], ROUTE_SEED + int(number)
    key = _digest([SIMULATOR, source_hash(RENDERING), kind, seed, hashlib.sha256(Ts.tobytes()).hexdigest()])

    def scans() -> Iterator[tuple[Sweep, np.ndarray]]:
        for k, scan in enumerate(simulate_route(Ts, kind, seed, rolling_shutter=True)):
            yield Sweep(scan.points, scan.times_s, k * FRAME_PERIOD_NS), scan.T_world_lidar

    return Sequence(f"route {number}, {kind}", len(Ts), key, scans)


def real(data: Path, name: str, bar: Progress) -> Sequence:
    """A recorded sequence."""
    drive = recorded(data, name, None, bar)
    digest = hashlib.sha256(drive.Ts_world_lidar.tobytes())
    for sweep in drive.sweeps:
        digest.update(sweep.points.tobytes() + str(sweep.stamp_ns).encode())
    pairs = list(zip(drive.sweeps, drive.Ts_world_lidar, strict=True))
    return Sequence(name, len(pairs), digest.hexdigest()[:16], lambda: iter(pairs))


def _digest(what: list) -> str:
    return hashlib.sha256(json.dumps(what).encode()).hexdigest()[:16]


class _Taken:
    """Pairs of one method so far; each scan is prepared once, and counted in every pair that it is in."""

    def __init__(self, method: PairMethod):
        self._method = method
        self._prepared: dict[int, tuple[Any, float]] = {}
        self.errors: dict[tuple[int, int], np.ndarray] = {}
        self.seconds: dict[tuple[int, int], float] = {}

    def solve(self, gap: int, number: int, scans: dict[int, np.ndarray], T_true: np.ndarray) -> None:
        """The pair of two scans, from the identity."""
        self._prepared = {k: ready for k, ready in self._prepared.items() if k in scans}
        (source, source_s), (target, target_s) = (self._ready(k, scans[k]) for k in (number, number + gap))
        begin = time.perf_counter()
        found = self._method.align(source, target, np.eye(4))
        self.seconds[gap, number] = time.perf_counter() - begin + source_s + target_s
        self.errors[gap, number] = se3.log(se3.inverse(se3.orthonormal(np.asarray(found.T_target_source))) @ T_true)

    def _ready(self, number: int, points: np.ndarray) -> tuple[Any, float]:
        if number not in self._prepared:
            begin = time.perf_counter()
            ready = self._method.prepare(points)
            self._prepared[number] = ready, time.perf_counter() - begin
        return self._prepared[number]

    def result(self) -> Pairs:
        """All of them."""
        errors, seconds = (np.array(list(values.values())) for values in (self.errors, self.seconds))
        return Pairs(errors.reshape(-1, 6), np.array([gap for gap, _ in self.errors]), seconds)


def taken_pairs(num_scans: int) -> set[tuple[int, int]]:
    """(gap, source) of the pairs."""
    return {(gap, int(k)) for gap in GAPS if num_scans > gap for k in np.unique(np.linspace(0, num_scans - gap - 1, NUM_PAIRS).astype(int))}


def run(sequence: Sequence, entries: dict[str, Entry], store: Path, bar: Progress) -> Results:
    """What all methods make of a sequence; what is in the store is not computed again, what is not is computed in one pass.

    Args:
        sequence: of at least six scans.
        entries: by name.
        store: folder.
        bar: progress.
    """
    store.mkdir(parents=True, exist_ok=True)
    poses, pairs, truth = _places(sequence, entries, store)
    new_poses, new_pairs = ([name for name, path in places.items() if not path.exists()] for places in (poses, pairs))
    if new_poses or new_pairs or not truth.exists():
        found = _one_pass(sequence, entries, new_poses, new_pairs, bar)
        for names, places, values in ((new_poses, poses, found.poses), (new_pairs, pairs, found.pairs)):
            for name in names:
                write_arrays(places[name], **values[name]._asdict())
        write_arrays(truth, Ts=found.Ts_world_lidar)
    known = {name: Poses(**_load(path)) for name, path in poses.items()}
    return Results(_load(truth)["Ts"], known, {name: Pairs(**_load(path)) for name, path in pairs.items()})


def is_stored(sequence: Sequence, entries: dict[str, Entry], store: Path) -> bool:
    """Whether `run` has nothing to compute."""
    poses, pairs, truth = _places(sequence, entries, store)
    return all(path.exists() for path in (*poses.values(), *pairs.values(), truth))


def _places(sequence: Sequence, entries: dict[str, Entry], store: Path) -> tuple[dict[str, Path], dict[str, Path], Path]:
    """Files of the poses and pairs by method, and of the truth."""

    def place(what: str, name: str = "", version: str = "") -> Path:
        return store / f"{_digest([sequence.key, what, name, version, GAPS, NUM_PAIRS])}.npz"

    poses = {name: place("poses", name, entry.version) for name, entry in entries.items() if entry.odometry is not None}
    pairs = {name: place("pairs", name, entry.version) for name, entry in entries.items() if entry.pair is not None}
    return poses, pairs, place("truth")


def _load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}


def _one_pass(sequence: Sequence, entries: dict[str, Entry], new_poses: list[str], new_pairs: list[str], bar: Progress) -> Results:
    """All scans once; odometries take turns at who is first."""
    running = [(name, start()) for name in new_poses if (start := entries[name].odometry) is not None]
    taken = {name: _Taken(make()) for name in new_pairs if (make := entries[name].pair) is not None}
    rows: dict[str, list[tuple[np.ndarray, float, bool]]] = {name: [] for name in new_poses}
    wanted = taken_pairs(sequence.num_scans)
    truth: list[np.ndarray] = []
    scans: dict[int, np.ndarray] = {}
    for k, (sweep, T) in enumerate(bar.track(sequence.scans(), total=sequence.num_scans, description=sequence.name)):
        truth.append(T)
        scans = {number: points for number, points in scans.items() if number >= k - max(GAPS)} | {k: sweep.points}
        shift = k % max(len(running), 1)
        for name, odometry in running[shift:] + running[:shift]:
            begin = time.perf_counter()
            frame = odometry.register(sweep.points, sweep.stamp_ns, sweep.times_s)
            rows[name].append((np.array(frame.T_world_lidar), time.perf_counter() - begin, frame.status == "ok"))
        for gap in (gap for gap in GAPS if (gap, k - gap) in wanted):
            for one in taken.values():
                one.solve(gap, k - gap, scans, se3.inverse(T) @ truth[k - gap])
    poses = {name: Poses(*(np.array(column) for column in zip(*found, strict=True))) for name, found in rows.items()}
    return Results(np.stack(truth), poses, {name: one.result() for name, one in taken.items()})
