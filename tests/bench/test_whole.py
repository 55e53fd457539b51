"""The whole command on small sizes."""

import pytest

from delo_jax.bench.report import DIRECTIONS, read_metrics
from delo_jax.cli import main


@pytest.mark.slow
def test_a_quick_run(tmp_path, capsys):
    """Oracle: the stages that a run has to name, and the rules of its metrics; times themselves are not judged."""
    path = tmp_path / "record.json"
    assert main(["bench", "--quick", "--json", str(path)]) == 0
    assert "quick run, no verdict" in capsys.readouterr().out
    metrics = read_metrics(path)
    stages = {metric.name.rsplit("/", 1)[0] for metric in metrics if metric.name.startswith("cpu/")}
    of_pair = "reading", "crop and voxels", "normals and features", "encode", "plan", "coarse", "fine", "evidence", "result to host", "pair"
    expected = {f"cpu/tiny/256/{name}" for name in of_pair} | {"cpu/tiny/training/train step", "cpu/tiny/training/input pipeline"}
    expected |= {"cpu/scan to scan/total", "cpu/stream on a map/total", "cpu/refinement/smoother", "cpu/refinement/network passes"}
    assert expected <= stages
    assert all(metric.unit and metric.direction in DIRECTIONS and metric.value >= 0 for metric in metrics)
