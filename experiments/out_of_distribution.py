"""Whether doubt grows away from what the network was trained on: epistemic variances of a pair, in and out of distribution.

Simulated worlds that no training has seen, the same worlds and motions in every condition, scans of an HDL-64E as measured at gaps of 1,
2, 3 and 5 frames, from the identity. Out of distribution: the beams of a VLP-16, which training has not seen; rain (three tenths of the
points lost, of the rest one ray in seven returned by a drop some metres from the sensor); gaps of 8 and of 10 frames, where training ended
at 5. Median over the pairs, axis by axis, of the calibrated covariance and of the evidence as it is;
beside it the median squared error.

Run:     python experiments/out_of_distribution.py       (about 5 minutes on 2 cores; clips are kept in runs/)
Expect:  all bounds kept.
"""

from pathlib import Path

import _harness
import numpy as np
from _harness import Row
from _uncertainty import Said, clips, frame_of, rain, relative, solved
from rich.progress import Progress

import delo_jax
from delo_jax.model.delo import Model
from delo_jax.report.calibration import ratios_figure
from delo_jax.uncertainty.observability import AXES

PAIRS = ((0, 1), (1, 3), (5, 2), (0, 5))
FAR = {"gap 8": ((0, 8), (10, 2)), "gap 10": ((0, 10), (10, 0))}
OTHER_SENSOR = "vlp16"
NUM_FRAMES, NUM_NEAR, NUM_CLIPS, NUM_QUICK = 11, 6, 60, 2
BOUND = 1.5
METHODS = ("full", "evidence")


def pairs_of(model: Model, folder: Path, count: int, bar: Progress) -> dict[str, list[Said]]:
    """Pairs by condition; the first is in distribution."""
    found: dict[str, list[Said]] = {name: [] for name in ("in distribution", f"beams of {OTHER_SENSOR}", "rain", *FAR)}
    cfg = model.cfg.preprocess
    also = tuple((frame, rain) for frame in range(NUM_NEAR))
    usual = clips(folder, count, num_frames=NUM_FRAMES, cfg=cfg, bar=bar, also=also)
    other = clips(folder, count, num_frames=NUM_NEAR, cfg=cfg, bar=bar, sensor=OTHER_SENSOR)
    for seen, strange in zip(usual, other, strict=True):
        frames = [frame_of(model, seen, frame) for frame in range(NUM_FRAMES + NUM_NEAR)]
        strange_frames = [frame_of(model, strange, frame) for frame in range(NUM_NEAR)]
        near = (frames, strange_frames, frames[NUM_FRAMES:])
        for name, scans in zip(found, near, strict=False):  # the rest are gaps
            found[name] += [solved(model, scans[a], scans[b], relative(seen.Ts_world_lidar, a, b)) for a, b in PAIRS]
        for name, pairs in FAR.items():
            found[name] += [solved(model, frames[a], frames[b], relative(seen.Ts_world_lidar, a, b)) for a, b in pairs]
    return found


def epistemic(said: list[Said], method: str) -> np.ndarray:
    """(6,) median variances."""
    return np.median([getattr(one, method).epistemic for one in said], axis=0)


def squared(said: list[Said]) -> np.ndarray:
    """(6,) median squared errors."""
    return np.median([one.error**2 for one in said], axis=0)


def show(found: dict[str, list[Said]]) -> dict[str, np.ndarray]:
    """Table of the ratios; those of the calibrated covariance."""
    usual = next(iter(found.values()))
    print("\n## Median epistemic variance / that in distribution\n")
    print(f"| condition | pairs | off | confidence | of | {' | '.join(AXES)} | mean |\n|---|---:|---:|---:|---|{'---:|' * 7}")
    ratios = {}
    for name, said in found.items():
        off, confidence = sum(one.off for one in said), np.median([one.confidence for one in said])
        lines = {method: epistemic(said, method) / epistemic(usual, method) for method in METHODS}
        for method, ratio in (lines | {"squared error": squared(said) / squared(usual)}).items():
            cells = " | ".join(f"{value:.2f}" for value in (*ratio, ratio.mean()))
            print(f"| {name} | {len(said)} | {off} | {confidence:.3f} | {method} | {cells} |")
            if method == METHODS[0] and said is not usual:
                ratios[name] = ratio
    sigma = 1e3 * np.sqrt(epistemic(usual, METHODS[0]))
    print(f"\nIn distribution, epistemic standard deviation of `full` [mrad, mm]: {', '.join(f'{value:.2f}' for value in sigma)}")
    return ratios


def main(argv: list[str] | None = None) -> int:
    """Solve, print, draw, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder for clips and the figure")
    args = parser.parse_args(argv)
    model = delo_jax.load(args.weights)
    with _harness.progress() as bar:
        ratios = show(pairs_of(model, args.out / "clips", NUM_QUICK if args.quick else NUM_CLIPS, bar))
    ratios_figure(args.out / "out_of_distribution.png", ratios, AXES, bound=BOUND, title="Epistemic variance, times that in distribution")
    rows = [
        Row(f"{name}: epistemic variance, mean over the axes", float(ratio.mean()), "times", BOUND, True) for name, ratio in ratios.items()
    ]
    return _harness.finish(rows, {"weights": args.weights, "clips": NUM_CLIPS}, args)


if __name__ == "__main__":
    _harness.run(main)
