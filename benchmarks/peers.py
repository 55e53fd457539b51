"""Times beside those of other packages, in one run: same scans, same threads, all taking turns at who is first.

Three parts, on the CPU, pinned to two cores. Reading or rendering, compiling and warm-up are apart; where several packages take turns, a
pause before each timed call lets the threads of the one before fall asleep.

- networks: `base` and `tiny` alone, warm, the older scan encoded already: from the newer prepared scan to the pose.
- drive: `delo run`, with its files, beside KISS-ICP (default configuration), small_gicp's GICP and VGICP, scan to scan and scan to model,
  and KISS-Matcher from the identity. Only their own calls are timed of the peers; settings: see `delo_jax/baselines/`.
- paper: the paper's network at N = 1024, D = 512 without its evidence head, jitted and in PyTorch (same weights, float32, inference mode).
  Ratios there are medians over the turns.

Run:     python benchmarks/peers.py [--data TREE --sequence NAME]     (about 12 minutes on 2 cores; needs '.[baselines,parity]')
Expect:  all bounds kept on an idle machine.
"""

import argparse
import os
import platform
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # read as packages load, like the numbers of threads
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "2"  # as `NUM_THREADS` says

sys.path.append(str(Path(__file__).parents[1] / "experiments"))

import _harness
import _peers_drive as drives
import _peers_networks as networks
import _peers_turns as turns
from _harness import Row
from rich.progress import Progress

import delo_jax
from delo_jax.baselines.protocols import NUM_THREADS
from delo_jax.bench.timing import UNKNOWN, Timing, paired_ratio

PARTS = ("networks", "drive", "paper")
MOST_MS = {networks.BASE: 25.0, networks.TINY_WIDE: 10.0, networks.TINY: 10.0}
SPREAD = 1.3  # p95 over p50 of `base`
P50_TO_KISS, P95_TO_KISS = 0.5, 0.4
TO_SOFTMAX, OVER_DENSE, OVER_WHOLE = 1.0, 1.5, 1.4
SAME_M, SAME_RAD = 1e-2, 1e-3  # the two networks are the same one


class Settings(NamedTuple):
    """How much is measured."""

    num_scans: int = drives.NUM_SCANS
    warm_up: int = 20  # scans of the drive, and calls of the presets, that do not count
    num_calls: int = 200  # of each preset
    num_paper: int = 60
    warm_up_paper: int = 5
    num_pairs: int = 8  # of successive scans, that the networks take in turns


QUICK = Settings(num_scans=12, warm_up=4, num_calls=5, num_paper=2, warm_up_paper=1, num_pairs=2)


def pin() -> list[int]:
    """Keeps the process on the cores that all get; returns them. JAX has no setting for its number of threads."""
    if not hasattr(os, "sched_setaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))[:NUM_THREADS]
    os.sched_setaffinity(0, cores)
    return cores


def machine(cores: list[int]) -> str:
    """Processor, threads and versions of the peers."""
    model = platform.processor() or platform.machine()
    if (info := Path("/proc/cpuinfo")).exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text(encoding="utf-8").splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    peers = ", ".join(f"{name} {_version(name)}" for name in ("torch", "kiss-icp", "small_gicp", "kiss-matcher", "numpy"))
    pinned = f"pinned to cores {cores}" if cores else "not pinned: this system has no affinity"
    return f"{model}; {peers}; {NUM_THREADS} threads for all, {pinned}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def load() -> str:
    """How busy the machine was lately."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "not known"


def network_rows(found: dict[str, Timing]) -> list[Row]:
    """Of the presets alone."""
    rows = [Row(f"network alone, {name}: p50", found[name].percentile(50), "ms", MOST_MS[name]) for name in MOST_MS if name in found]
    if networks.BASE in found:
        base = found[networks.BASE]
        rows.append(Row(f"network alone, {networks.BASE}: p95 / p50", base.percentile(95) / base.percentile(50), "ratio", SPREAD))
    return rows


def drive_rows(found: dict[str, Timing]) -> list[Row]:
    """Of `delo run`, and beside each peer."""
    ours, bounds = found[drives.OURS], {50: P50_TO_KISS, 95: P95_TO_KISS}
    return [
        Row(
            f"{drives.OURS} / {name}: p{percent}",
            ours.percentile(percent) / timing.percentile(percent),
            "ratio",
            bounds[percent] if name == drives.KISS else None,
        )
        for name, timing in found.items()
        if name in drives.PEERS
        for percent in bounds
    ]


def paper_rows(found: networks.PaperSize) -> list[Row]:
    """Of the network at paper size; what wants PyTorch, where there is none, is not known, and so missed."""
    n, by, same = networks, found.timings, "both softmax networks: largest difference of the"
    over = [
        (n.SOFTMAX, n.TORCH_SOFTMAX, TO_SOFTMAX, False),
        (n.TORCH_DENSE, n.TRANSPORT, OVER_DENSE, True),
        (n.TORCH_SCALED, n.TRANSPORT, None, True),
        (n.TRANSPORT, n.STREAMING, OVER_WHOLE, True),
    ]
    rows = []
    for above, below, bound, at_least in over:
        ratio = paired_ratio(by[above], by[below]) if {above, below} <= set(by) else UNKNOWN
        rows.append(Row(f"{above} / {below}", ratio, "ratio", bound, at_least))
    rows.append(Row(f"{same} translation", found.apart_m, "m", SAME_M))
    return [*rows, Row(f"{same} rotation matrix", found.apart_rad, "", SAME_RAD)]


def take_drive(args: argparse.Namespace, num_scans: int, bar: Progress) -> drives.Drive:
    """The scans, all in memory."""
    task = bar.add_task("reading" if args.data else "rendering", total=num_scans)

    def advance() -> None:
        bar.advance(task)

    return drives.recorded(args.data, args.sequence, num_scans, advance) if args.data else drives.simulated(num_scans, advance)


def run_drive(drive: drives.Drive, settings: Settings, bar: Progress) -> list[Row]:
    """Times all odometries and prints them."""
    task = bar.add_task("drive", total=len(drive.sweeps))
    with tempfile.TemporaryDirectory() as folder:
        methods = drives.odometries(delo_jax.load("delo-base"), Path(folder))
        found, poses = drives.follow(drive, methods, settings.warm_up, lambda: bar.advance(task))
        drives.close(methods)
    errors = drives.step_errors(drive, poses, settings.warm_up)
    print("\n" + turns.table(drive.name, found, errors, "error of a step, median / largest cm"), flush=True)
    return drive_rows(found)


def measured(parts: list[str], drive: drives.Drive, settings: Settings, bar: Progress, *, quick: bool) -> list[Row]:
    """All rows."""
    rows, pairs = list[Row](), drives.pairs(drive, settings.num_pairs)
    if "networks" in parts:
        found = networks.time_presets(pairs, settings.num_calls, settings.warm_up, small=quick)
        print("\n" + turns.table("network alone", found), flush=True)
        rows += network_rows(found)
    if "paper" in parts:
        paper = networks.time_paper(pairs, settings.num_paper, settings.warm_up_paper)
        print("\n" + turns.table("paper size, N = 1024, D = 512", paper.timings), flush=True)
        rows += paper_rows(paper)
        if missing := networks.torch_missing():
            print(f"\n{missing}", flush=True)
    if "drive" in parts:
        rows += run_drive(drive, settings, bar)
    return rows


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Options."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="what is measured; other bounds are not judged")
    parser.add_argument("--data", type=Path, help="tree of recorded sequences; a simulated drive by default")
    parser.add_argument("--sequence", default="odo_00_056", help="of that tree")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    args = parse(argv)
    settings, about, before = QUICK if args.quick else Settings(), machine(pin()), load()
    print(f"{about}; load {before}", flush=True)
    num_scans = settings.num_scans if "drive" in args.parts else 2 * settings.num_pairs
    with _harness.progress() as bar:
        drive = take_drive(args, num_scans, bar)
        rows = measured(args.parts, drive, settings, bar, quick=args.quick)
    print(f"\n{about}; load {before} before, {load()} after")
    return _harness.finish(rows, settings._asdict() | {"parts": args.parts, "drive": drive.name, "machine": about}, args)


if __name__ == "__main__":
    _harness.run(main)
