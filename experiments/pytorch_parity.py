"""The published network at full size gives the same numbers as an independent PyTorch implementation of it.

1024 points, 512 channels, shared random weights and running statistics, presets `paper`, `official` and `dcp`, from points to
pose: features, embeddings, scores, plan, pose and evidence. Ours in float32, PyTorch in float64; the difference is the largest of a
tensor as a share of its largest value.

Run:     pip install '.[parity,test]' && python experiments/pytorch_parity.py     (about a minute on 2 cores; a CPU build of PyTorch does)
Expect:  every difference at most 1e-4.
"""

import sys
from pathlib import Path

import _harness
from _harness import Row

from delo_jax.errors import ConfigError

sys.path.insert(0, str(Path(__file__).parents[1]))  # the twin is a test oracle
PRESETS = ("paper", "official", "dcp")
BOUND = 1e-4


def main(argv: list[str] | None = None) -> int:
    """Compare, print, judge."""
    args = _harness.parser(__doc__, needs_data=False).parse_args(argv)
    try:
        from tests.oracles import parity
    except ModuleNotFoundError as error:
        raise ConfigError(f"PyTorch: expected it to be installed, got {error}; run pip install '.[parity,test]'") from error
    found = {preset: parity.compare(preset) for preset in PRESETS}
    print("| tensor | " + " | ".join(found) + " |\n|---|" + "---:|" * len(found))
    for name in found["paper"]:
        print(f"| {name} | " + " | ".join(f"{by_name[name]:.1e}" if name in by_name else "none" for by_name in found.values()) + " |")
    rows = [Row(f"{preset}: largest difference", 1e6 * max(by_name.values()), "1e-6", 1e6 * BOUND) for preset, by_name in found.items()]
    return _harness.finish(rows, {"presets": PRESETS, "bound": BOUND}, args)


if __name__ == "__main__":
    _harness.run(main)
