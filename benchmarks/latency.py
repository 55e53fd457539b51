"""Time of every stage of a pair by preset and number of points, of streams and of training, on full simulated HDL-64E scans.

Run:     python benchmarks/latency.py [--quick]        (about ten minutes on 2 cores; options are those of `delo bench`)

Compared with baseline.json; exits 1 when a ratio within the run has got worse than its tolerance there. Renewed on an idle machine by
`python benchmarks/latency.py --json benchmarks/baseline.json`.
"""

import sys
from pathlib import Path

from delo_jax.cli import main

BASELINE = Path(__file__).parent / "baseline.json"

if __name__ == "__main__":
    own = [] if any(word.startswith("--baseline") for word in sys.argv) or not BASELINE.exists() else ["--baseline", str(BASELINE)]
    sys.exit(main(["bench", *own, *sys.argv[1:]]))
