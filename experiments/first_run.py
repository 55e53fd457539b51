"""What a newcomer waits for: a fresh environment, the installation, and `delo demo`.

Run:     python experiments/first_run.py        (about 2 minutes on 2 cores, with a package index at hand)
Expect:  less than 3 minutes in all.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import _harness
from _harness import Row


def seconds(*command: str | Path, cwd: Path) -> float:
    """Wall time of a command that has to succeed [s]."""
    begin = time.perf_counter()
    subprocess.run([str(part) for part in command], cwd=cwd, check=True, stdout=sys.stderr)
    return time.perf_counter() - begin


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    args = _harness.parser(__doc__, needs_data=False).parse_args(argv)
    checkout = Path(__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        environment = seconds(sys.executable, "-m", "venv", work / "venv", cwd=work)
        install = seconds(work / "venv/bin/pip", "install", "--quiet", checkout, cwd=work)
        demo = seconds(work / "venv/bin/delo", "demo", "--num-scans", "10" if args.quick else "60", cwd=work)
    rows = [
        Row("environment", environment, "s"),
        Row("installation", install, "s"),
        Row("delo demo", demo, "s"),
        Row("in all", environment + install + demo, "s", 180.0),
    ]
    return _harness.finish(rows, {"num_scans": 60}, args)


if __name__ == "__main__":
    _harness.run(main)
