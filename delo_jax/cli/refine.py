"""`delo refine`: the pose graph of a finished run."""

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from delo_jax.cli.command import Command
from delo_jax.cli.stored import StoredFrames, facts_of, frames_of, options_of
from delo_jax.config import RefineConfig
from delo_jax.errors import DatasetError

if TYPE_CHECKING:
    from delo_jax.data.dataset import Dataset
    from delo_jax.inference import PreparedScan
    from delo_jax.model.delo import Model
    from delo_jax.refine.plan import Factors
    from delo_jax.refine.refiner import Record
    from delo_jax.report.cloud import DriveCloud


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refine(Command):
    """Refines a finished run: frames two and four apart are registered to each other, places seen again too, and the graph is solved.

    Example: delo refine runs/07
    """

    folder: tyro.conf.Positional[Path]
    """Folder of a run; the refined poses go there too."""
    data: Path | None = None
    """Where the scans are now, if the run's own path is not right any more."""
    graph: RefineConfig = RefineConfig()
    """Which pairs of frames count."""
    no_loops: bool = False
    """Leave out places that were seen again."""
    backend: Literal["gtsam", "jax"] = "gtsam"
    """gtsam: sparse, any length; jax: matrix-free by optimistix, up to 1,000 frames."""

    def run(self) -> int:
        """Registers pairs, solves, writes the refined poses and their covariances, report.html anew, and prints what was gained."""
        from delo_jax.cli.console import print_summary
        from delo_jax.cli.page import write_page
        from delo_jax.cli.refinement import FILES, refine, write
        from delo_jax.cli.summary import refinement_rows
        from delo_jax.refine.jax_backend import check_length
        from delo_jax.report.cloud import DriveCloud

        facts, options = facts_of(self.folder), options_of(self.folder)
        if facts.get("method", "delo") != "delo":
            why = "whose covariances say what a motion counts"
            raise DatasetError(f"{self.folder}: expected a run of --method delo, {why}, got one of {facts['method']}; run again with delo")
        frames = frames_of(self.folder, facts)
        if len(frames.Ts_world_lidar) < 2:
            raise DatasetError(f"{self.folder}: expected a run of two or more frames, got {len(frames.Ts_world_lidar)}; nothing to refine")
        if self.backend == "jax":
            check_length(len(frames.Ts_world_lidar))
        scans = Scans(_weights_of(self.folder, facts), self._open(facts, options), frames, deskew=options.get("deskew") != "off")
        if len(scans.dataset) < len(frames.stamps_ns):
            what = f"expected the {len(frames.stamps_ns)} scans of the run, got {len(scans.dataset)}"
            raise DatasetError(f"{scans.dataset.name}: {what}; give their folder by --data")
        cloud = DriveCloud()
        record, Ts_online = _passes(scans, self.graph, cloud)
        loops = None if self.no_loops else _loops(scans, record)
        found = refine(record, Ts_online, loops=loops, backend=self.backend)
        T_cam_lidar = facts.get("T_cam_lidar")
        write(self.folder, found, frames.stamps_ns, None if T_cam_lidar is None else np.array(T_cam_lidar))
        truth = scans.dataset.truth
        if truth is not None:
            truth = truth[: len(frames.stamps_ns)]
        page = write_page(self.folder, cloud, truth=truth, refinement=found, loops=None if loops is None else len(loops.sources))
        print_summary(refinement_rows(found, frames.Ts_world_lidar, truth), "pose graph")
        print(f"{', '.join([*FILES, page.name])}: {self.folder}")
        return 0

    def _open(self, facts: dict[str, Any], options: dict[str, Any]) -> "Dataset":
        from delo_jax.data.dataset import open_dataset

        stored = facts.get("dataset") or {}
        path = self.data or stored.get("path")
        if path is None:
            raise DatasetError(f"{self.folder}: expected a run on stored scans, got a {stored.get('name')}; its own command refines it")
        return open_dataset(
            path,
            sequence=stored.get("sequence"),
            elevation_correction=not options.get("no_elevation_correction", False),
            azimuth_times=options.get("deskew") == "on",
        )


def _weights_of(folder: Path, facts: dict[str, Any]) -> "Model":
    """Those that the run was made with."""
    from delo_jax import weights

    stored = facts.get("weights") or {}
    if not {"name", "sha256"} <= set(stored):
        raise DatasetError(f"{folder / 'run.json'}: expected name and SHA-256 of the weights, got {stored}; run again")
    if weights.read_card(stored["name"])["sha256"] != stored["sha256"]:
        raise DatasetError(f"{folder}: expected the weights that it was made with, got others of the name {stored['name']}; run again")
    return weights.load(stored["name"])


class Scans:
    """The scans of a run, prepared and de-skewed as far as its poses say how."""

    def __init__(self, params: "Model", dataset: "Dataset", frames: StoredFrames, *, deskew: bool):
        self.params, self.dataset, self.frames, self._deskew = params, dataset, frames, deskew
        self.again = functools.lru_cache(maxsize=64)(self.prepared)
        """The same, the last ones kept."""

    def prepared(self, number: int) -> "PreparedScan | None":
        """A scan de-skewed with the mean velocity that the poses say, not that within the sweep; None where it was rejected."""
        from delo_jax import inference

        if self.frames.rejected[number]:
            return None
        scan = self.dataset[number]
        times_s = scan.times if self._deskew else None
        return inference.prepare(self.params, scan.points, times_s).still(self._velocity(number))

    def _velocity(self, number: int) -> np.ndarray | None:
        """(6,) of the sensor then; that of the next motion where the scan was the first."""
        from delo_jax.geometry import se3

        stamps_ns, Ts, since, rejected = self.frames[:4]
        end = number if since[number] < number else number + 1
        if end >= len(Ts) or rejected[end]:
            return None
        start = since[end]
        return se3.log(se3.inverse(Ts[start]) @ Ts[end]) / (1e-9 * (stamps_ns[end] - stamps_ns[start]))


def _passes(scans: Scans, cfg: RefineConfig, cloud: "DriveCloud") -> "tuple[Record, np.ndarray]":
    """What the network says of frames that are a few apart, and the smoothed poses."""
    from delo_jax.cli.console import progress
    from delo_jax.refine.refiner import Refiner, Tracked

    frames = scans.frames
    rows = zip(frames.since, frames.Ts_world_lidar, frames.covariances, frames.local, strict=True)
    with progress() as bar, Refiner(scans.params, cfg) as refiner:
        task = bar.add_task("registering pairs", total=len(frames.since), note="")
        for number, (since, T, covariance, local) in enumerate(rows):
            prepared = scans.prepared(number)
            refiner.add(Tracked(int(since), T, covariance, local, prepared))
            if prepared is not None:
                cloud.add_scan(number, T, prepared)
            bar.advance(task)
    return refiner.record, refiner.Ts_world_lidar


def _loops(scans: Scans, record: "Record") -> "Factors":
    """Factors of places that were seen again."""
    from delo_jax import inference
    from delo_jax.cli.console import progress
    from delo_jax.refine import loops

    chain = loops.Chain.of(record.plan())
    pairs = loops.propose(chain, ~scans.frames.rejected)
    there, back = [], []
    with progress("pairs") as bar:
        task = bar.add_task("closing loops", total=len(pairs), note="")
        for earlier, later in pairs.tolist():
            a, b = (scans.again(number) for number in (earlier, later))
            if a is not None and b is not None:  # rejected frames are not proposed
                there.append(inference.align(scans.params, a, b, np.eye(4)))
                back.append(inference.align(scans.params, b, a, np.eye(4)))
            bar.advance(task)
    kept = loops.verify(chain, pairs, there, back, record.local)
    print(f"loops: {len(pairs)} proposed, {len(kept.sources)} kept")
    return kept
