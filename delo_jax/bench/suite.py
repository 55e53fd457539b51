"""One run of everything, and the ratios within it that later runs are held to."""

import contextlib
import os
import platform as host
import resource
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version

import jax

from delo_jax import weights
from delo_jax.bench.pair import BATCH, SINGLE, TOGETHER, measure_pair
from delo_jax.bench.report import Metric, Report, known, metrics_of_row
from delo_jax.bench.roofline import Machine, best, measure_machine
from delo_jax.bench.rows import PRODUCT, Group, LeftOut, Row
from delo_jax.bench.streams import Groups, measure_scan_to_scan, measure_stream
from delo_jax.bench.timing import Effort, nothing_kept, paired_ratio
from delo_jax.bench.training import measure_training, training_world
from delo_jax.sim import simulate_drive
from delo_jax.sim.drive import DRIVE_SEED

PRESETS = ("tiny", "base", "paper")
POINTS = (256, 512, 1024, 2048, 4096)
TOLERANCE = {
    "pair": 0.6,
    "batched": 0.5,
    "encode": 0.5,
    "step": 0.6,
    "stream": 0.6,
}  # busy, they are smaller


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to measure, and how long."""

    presets: tuple[str, ...] = PRESETS
    points: tuple[int, ...] = POINTS
    effort: Effort = Effort(50, 0.6, min_calls=3)
    batched: bool = True
    """Pairs several at once, too."""
    num_scans: int = 200
    """From scan to scan."""
    num_stream_scans: int = 110
    warm_up: int = 20
    """Scans before those that count."""
    weights: str = "delo-base"
    """Of the streams."""


def quick(settings: Settings) -> Settings:
    """The first preset with the fewest points, and few calls."""
    few = Effort(5, 0.2, warm_up=1)
    return Settings(
        presets=settings.presets[:1],
        points=(min(settings.points),),
        effort=few,
        batched=False,
        num_scans=10,
        num_stream_scans=10,
        warm_up=5,
        weights=settings.weights,
    )


def platforms() -> tuple[str, ...]:
    """The default one and, unless the environment leaves it out, the CPU."""
    default = jax.default_backend()
    try:
        jax.devices("cpu")
    except RuntimeError:
        return (default,)
    return tuple(dict.fromkeys((default, "cpu")))


@contextlib.contextmanager
def on(platform: str) -> Iterator[None]:
    """Makes a platform the default meanwhile, in all threads."""
    before = jax.config.values["jax_default_device"]
    jax.config.update("jax_default_device", jax.devices(platform)[0])
    try:
        yield
    finally:
        jax.config.update("jax_default_device", before)


def run(settings: Settings, note: Callable[[str], None] = lambda what: None) -> Report:
    """Measures everything on every platform that is there.

    Args:
        settings: what, and how long.
        note: told what comes next.

    Raises:
        DeloError: weights that cannot be used.
    """
    note("simulating scans")
    scans = [scan.points for scan in simulate_drive("mixed", 3, 8)]
    worlds = {preset: training_world(preset) for preset in settings.presets}
    machines, rows, metrics, left_out = dict[str, Machine](), list[Row](), list[Metric](), list[LeftOut]()
    for platform in platforms():
        with on(platform), nothing_kept():
            note(f"{platform}: the machine itself")
            machine, groups = measure_machine(), list[Group]()

            def group(name: str, platform=platform, machine=machine, groups=groups) -> Group:
                groups.append(Group(f"{platform}/{name}", machine, settings.effort))
                note(groups[-1].name)
                return groups[-1]

            for preset in settings.presets:
                for num_points in settings.points:
                    one = group(f"{preset}/{num_points}")
                    left_out += measure_pair(preset, num_points, [scans[1], scans[0]], one, batched=settings.batched)
                left_out += measure_training(preset, worlds[preset], group(f"{preset}/training"))
            params = weights.load(settings.weights)
            measure_scan_to_scan(params, scans, settings.num_scans, settings.warm_up, group("scan to scan"))
            drive = simulate_drive("urban", DRIVE_SEED + 127, settings.warm_up + settings.num_stream_scans, rolling_shutter=True)
            measure_stream(params, drive, settings.warm_up, Groups(group("stream on a map"), group("refinement")))
            machines[platform] = best(machine, measure_machine())
            found = [row for entry in groups for row in entry.rows]
            metrics += [metric for row in found for metric in metrics_of_row(row, machines[platform])]
            metrics += ratios(found) + machine_metrics(platform, machines[platform])
            rows += found
    return Report(device_line(), machines, rows, metrics, left_out)


def ratios(rows: list[Row]) -> list[Metric]:
    """What gates may be on: medians over each other, or over that of a matrix product in the same group; several pairs and one by turns."""
    timings = {(row.group, row.stage): row.timing for row in rows}
    median = {key: timing.percentile(50) for key, timing in timings.items()}
    found = []

    def add(name: str, above: float, below: float, kind: str) -> None:
        found.append(Metric(name, above / below if below > 0 else float("nan"), "ratio", "lower", TOLERANCE[kind]))

    for (group, stage), value in median.items():
        if stage == "pair":
            add(f"{group}/pair over product", value, median[group, PRODUCT], "pair")
            add(f"{group}/encode over pair", median[group, "encode"], value, "encode")
        elif stage == TOGETHER:
            ratio = paired_ratio(timings[group, TOGETHER], timings[group, SINGLE])
            add(f"{group}/batched over single", ratio, float(BATCH), "batched")
        elif stage == "train step":
            add(f"{group}/step over product", value, median[group, PRODUCT], "step")
        elif group.endswith("stream on a map") and stage == "total":
            add(f"{group}/scan over product", value, median[group, PRODUCT], "stream")
    return known(found)


def machine_metrics(platform: str, machine: Machine) -> list[Metric]:
    """Rates, and the most memory that was ever in use."""
    found = [
        Metric(f"{platform}/machine/bandwidth", machine.bandwidth, "byte/s", "higher"),
        Metric(f"{platform}/machine/float32 product", machine.gemm, "flop/s", "higher"),
    ]
    if platform == "cpu":
        in_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return [*found, Metric("cpu/machine/peak resident memory", 1024.0 * in_kib, "byte", "lower")]
    stats = jax.devices(platform)[0].memory_stats() or {}
    return known([*found, Metric(f"{platform}/machine/peak memory", stats.get("peak_bytes_in_use", float("nan")), "byte", "lower")])


def device_line() -> str:
    """Versions and devices of this run, in a line."""
    devices = ", ".join(str(device.device_kind) for device in jax.devices())
    return f"{host.machine()}, {os.cpu_count()} cores, JAX {jax.__version__} on {devices}, delo-jax {version('delo-jax')}"
