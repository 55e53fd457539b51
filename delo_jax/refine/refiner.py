"""Refines a stream in a second thread: network passes between frames, the gate, and the fixed-lag smoother; odometry does not wait."""

import dataclasses
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from delo_jax import inference
from delo_jax.config import RefineConfig
from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.inference import Estimate, PreparedScan
from delo_jax.model.delo import Model
from delo_jax.refine.fixed_lag import FixedLagSmoother
from delo_jax.refine.plan import MULTI_FRAME, Factors, Plan, between_frames, joined, odometry_factors
from delo_jax.uncertainty import gate

MAX_WAITING = 20  # frames; whoever streams faster than the passes waits then


class Tracked(NamedTuple):
    """A frame of the odometry."""

    since: int
    """Number of the frame that its motion starts from."""
    T_world_lidar: np.ndarray
    covariance: np.ndarray
    """(6, 6) of the pose."""
    local: np.ndarray
    """(6, 6) the part of it that is not handed on."""
    scan: PreparedScan | None
    """As it was registered; None where it was rejected."""


@dataclasses.dataclass
class Record:
    """What the refiner has found so far."""

    frames: list[Tracked] = dataclasses.field(default_factory=list)  # scans left out
    factors: list[Factors] = dataclasses.field(default_factory=list)  # beside the odometry's, of those that count
    counts: Counter = dataclasses.field(default_factory=Counter)  # verdicts, and pairs without a pose
    pass_s: list[float] = dataclasses.field(default_factory=list)  # per frame
    smooth_s: list[float] = dataclasses.field(default_factory=list)

    @property
    def local(self) -> np.ndarray:
        """(n, 6, 6)."""
        return np.stack([frame.local for frame in self.frames])

    def plan(self, loops: Factors | None = None) -> Plan:
        """The graph of all frames."""
        Ts = np.stack([frame.T_world_lidar for frame in self.frames])
        since = np.array([frame.since for frame in self.frames])
        chain = odometry_factors(Ts, since, np.stack([frame.covariance for frame in self.frames]), self.local)
        return Plan(Ts, joined([chain, *self.factors, *([] if loops is None else [loops])]))


class Refiner:
    """Takes the frames of an odometry, one by one, and smooths them. A context manager: left by an error, it drops what is waiting.

    Args:
        params: weights.
        cfg: which pairs count.
        align: two scans and a start to an estimate; `inference.align` by default.
    """

    def __init__(
        self,
        params: Model,
        cfg: RefineConfig | None = None,
        *,
        align: Callable[[Model, PreparedScan, PreparedScan, np.ndarray], Estimate] = inference.align,
    ):
        self._params, self._cfg, self._align = params, cfg or RefineConfig(), align
        self._quantiles = gate.Quantiles.of(params.variables)
        self._scans: deque[PreparedScan | None] = deque(maxlen=max(self._cfg.odometry_gap, self._cfg.key_gap) + 1)
        self._smoother: FixedLagSmoother | None = None
        self._error: Exception | None = None
        self._stopped = False
        self.record = Record()
        self._waiting: queue.Queue[Tracked | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._run, name="refiner", daemon=True)
        self._thread.start()

    def add(self, frame: Tracked) -> None:
        """The next frame; returns at once, unless twenty frames are waiting. After an error in the thread frames are dropped."""
        self._waiting.put(frame)

    def close(self) -> Record:
        """Waits for the frames that are still there.

        Raises:
            DeloError: what went wrong in the thread.
        """
        self._waiting.put(None)
        self._thread.join()
        if self._error is not None:
            kind = "" if isinstance(self._error, DeloError) else f"{type(self._error).__name__}: "
            raise DeloError(f"refinement: {kind}{self._error}") from self._error
        return self.record

    def stop(self) -> None:
        """Ends the thread after the frame that it is at; nothing happens where it has ended."""
        self._stopped = True
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()

    @property
    def Ts_world_lidar(self) -> np.ndarray:
        """(n, 4, 4) poses of the frames so far, as last smoothed."""
        return np.stack(self._smoother.Ts_world_lidar) if self._smoother is not None else np.zeros((0, 4, 4))

    def __enter__(self) -> "Refiner":
        """Itself."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Ends the thread; does not hide another error."""
        if kind is None:
            self.close()
        else:
            self.stop()

    def _run(self) -> None:
        while (frame := self._waiting.get()) is not None:
            if self._error is None and not self._stopped:
                try:
                    self._take(frame)
                except Exception as error:  # for the caller; the queue is still emptied, so that nobody waits for ever
                    self._error = error

    def _take(self, frame: Tracked) -> None:
        record, number = self.record, len(self.record.frames)
        record.frames.append(frame._replace(scan=None))
        self._scans.append(frame.scan)
        begin = time.perf_counter()
        found, refine = self._passes(number)
        between = time.perf_counter()
        if self._smoother is None:
            self._smoother = FixedLagSmoother(frame.T_world_lidar)
        else:
            last = [number - 1, number] if frame.since >= number else [frame.since, number]
            self._smoother.add(self._motion(*last), found)
            if refine:
                self._smoother.iterate()
        record.factors += [found] if found is not None else []
        record.pass_s.append(between - begin)
        record.smooth_s.append(time.perf_counter() - between)

    def _motion(self, source: int, target: int) -> Factors:
        """The odometry's factor of the newest frame."""
        ends = [self.record.frames[number] for number in (source, target)]
        Ts, covariances, local = (np.stack(arrays) for arrays in list(zip(*ends, strict=True))[1:4])
        row = odometry_factors(Ts, np.zeros(2, int), covariances, local)
        return row._replace(sources=np.array([source]), targets=np.array([target]))

    def _passes(self, number: int) -> tuple[Factors | None, bool]:
        """Factors of the pairs that end here and count, and whether one of key frames does."""
        cfg, kept, refine = self._cfg, [], False
        if cfg.odometry_gap and number >= cfg.odometry_gap:
            kept.append(self._pair(number, cfg.odometry_gap)[0])
        if cfg.key_gap and number >= cfg.key_gap and number % cfg.key_gap == 0:
            row, estimate = self._pair(number, cfg.key_gap)
            if estimate is not None:
                verdict = self._verdict(estimate)
                self.record.counts[f"{verdict.action} ({verdict.region})"] += 1
                refine = verdict.action == "refine"
                kept += [row] if refine else []
        rows = [row for row in kept if row is not None]
        return (joined(rows) if rows else None), refine

    def _verdict(self, estimate: Estimate) -> gate.Verdict:
        if self._quantiles is None:
            return gate.Verdict("refine", "not calibrated")
        return gate.judge(gate.confidence(estimate.epistemic, self._quantiles), self._cfg)

    def _pair(self, number: int, gap: int) -> tuple[Factors | None, Estimate | None]:
        """A network pass of two frames, independent of the map; None where it finds no pose to rely on."""
        source, target = self._scans[-1 - gap], self._scans[-1]
        if source is None or target is None:
            return None, None
        ends = self.record.frames[number - gap], self.record.frames[number]
        guess = se3.inverse(ends[1].T_world_lidar) @ ends[0].T_world_lidar
        estimate = self._align(self._params, source, target, guess)
        if estimate.status != "ok":
            self.record.counts[f"no factor ({estimate.status})"] += 1
            return None, None
        motion = estimate.inverted()
        local = np.stack([end.local for end in ends])
        row = between_frames(np.array([[0, 1]]), motion.T_target_source[None], motion.covariance[None], local, MULTI_FRAME)
        return row._replace(sources=row.sources + number - gap, targets=row.targets + number - 1), estimate
