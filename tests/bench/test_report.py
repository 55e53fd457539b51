"""Named metrics, their tables and JSON, and the comparison with a baseline."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.bench import suite
from delo_jax.bench.report import DIRECTIONS, Metric, Report, compare, comparison, metrics_of_row, missing, read_metrics, tables, to_json
from delo_jax.bench.roofline import Machine
from delo_jax.bench.rows import PRODUCT, LeftOut, Row
from delo_jax.bench.timing import NOT_BUILT, UNKNOWN, Build, Cost, Timing
from delo_jax.cli import main
from delo_jax.errors import ConfigError

MACHINE = Machine(bandwidth=1e9, gemm=2e11)
BUILT = Build(1.0, 2.0, 300.0, Cost(5e6, 2e6, 3e6))


def row(group, stage, ms, build=NOT_BUILT, batch=1):
    """A stage whose calls all take so long."""
    return Row(group, stage, Timing(build, 2 * ms, (ms,) * 3), batch)


ROWS = [
    *(row(f"cpu/{group}", PRODUCT, 10.0) for group in ("base/1024", "base/training", "stream on a map")),
    row("cpu/base/1024", "encode", 5.0, BUILT),
    row("cpu/base/1024", "solve", 20.0, BUILT),
    row("cpu/base/1024", "pair", 40.0),
    row("cpu/base/1024", "encode twice and solve", 60.0, BUILT, 4),
    row("cpu/base/1024", "one pair beside it", 30.0),
    row("cpu/base/training", "train step", 500.0, BUILT, 8),
    row("cpu/stream on a map", "total", 25.0),
]
METRICS = [metric for entry in ROWS for metric in metrics_of_row(entry, MACHINE)] + suite.ratios(ROWS)
REPORT = Report("here", {"cpu": MACHINE}, ROWS, METRICS, [])


def test_ratios_within_a_run():
    """Oracle: by hand from the times above; 60 ms for four pairs is half of 30 ms for each."""
    found = {metric.name: metric.value for metric in suite.ratios(ROWS)}
    assert found == pytest.approx(
        {
            "cpu/base/1024/pair over product": 4.0,
            "cpu/base/1024/encode over pair": 0.125,
            "cpu/base/1024/batched over single": 0.5,
            "cpu/base/training/step over product": 50.0,
            "cpu/stream on a map/scan over product": 2.5,
        }
    )


def test_every_metric_says_what_it_is():
    """Oracle: the rules: one name, one unit, one direction, a finite value; a tolerance on ratios of one run alone."""
    metrics = METRICS + suite.machine_metrics("cpu", MACHINE)
    names = [metric.name for metric in metrics]
    assert len(set(names)) == len(names)
    for metric in metrics:
        assert metric.unit
        assert metric.direction in DIRECTIONS
        assert math.isfinite(metric.value)
        assert metric.tolerance == 0.0 or metric.unit == "ratio"
    assert sum(metric.tolerance > 0 for metric in metrics) == 5


def test_numbers_of_a_row():
    """Oracle: by hand; 8 pairs in 500 ms, 2 MB at 1 GB/s in 2 ms at least."""
    found = {
        metric.name.rsplit("/", 1)[1]: metric.value
        for metric in metrics_of_row(next(entry for entry in ROWS if entry.stage == "train step"), MACHINE)
    }
    assert found["rate"] == pytest.approx(16.0)
    assert (found["trace"], found["lower"], found["compile"], found["first call"]) == (1.0, 2.0, 300.0, 1000.0)
    assert found["roofline gap"] == pytest.approx(250.0)


@pytest.mark.parametrize(
    ("direction", "value", "tolerance", "worse", "ok"),
    [
        ("lower", 12.0, 0.25, 1.2, True),
        ("lower", 13.0, 0.25, 1.3, False),
        ("lower", 5.0, 0.25, 0.5, True),
        ("higher", 8.0, 0.3, 1.25, True),
        ("higher", 5.0, 0.3, 2.0, False),
        ("lower", 99.0, 0.0, 9.9, True),
        ("lower", math.nan, 0.25, math.nan, False),
    ],
)
def test_gates(direction, value, tolerance, worse, ok):
    """Oracle: by hand, against a baseline of 10; its tolerance counts, not that of the run; without one nothing is a gate."""
    found = compare([Metric("m", value, "ratio", direction, 77.0)], [Metric("m", 10.0, "ratio", direction, tolerance)])
    assert len(found) == 1
    np.testing.assert_allclose(found[0].worse, worse)
    assert found[0].ok is ok
    assert found[0].metric.tolerance == tolerance
    assert "| m |" in comparison(found) or ok


def test_a_gate_that_was_not_measured_is_missing():
    """Oracle: by hand: of what was asked for, what was neither measured nor left out, and is a gate."""
    baseline = [Metric(f"cpu/{name}", 1.0, "ratio", "lower", 0.5) for name in ("a/1/x", "a/1/y", "b/1/x", "c/1/x", "a/16/x")]
    baseline.append(Metric("cpu/a/1/time", 1.0, "ms", "lower"))
    groups = ["cpu/a/1", "cpu/b/1"]
    assert missing([baseline[0]], baseline, [LeftOut("cpu/b/1", "too big")], groups) == ["cpu/a/1/y"]


def test_json_is_the_baseline_of_later_runs(tmp_path):
    """Oracle: the standard library's parser, and the metrics that went in."""
    path = tmp_path / "record.json"
    path.write_text(to_json(REPORT, quick=False, time="now"))
    record = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert record["quick"] is False
    assert record["metrics"][0] == METRICS[0]._asdict()
    assert read_metrics(path) == METRICS


@pytest.mark.parametrize("text", ["", "{}", '{"metrics": [{"name": 1}]}', '{"metrics": [["m", 1, "ratio", "up", 0.1]]}', "[]"])
def test_another_file_is_refused(text, tmp_path):
    """Oracle: the kind of error, and the path in its sentence."""
    path = tmp_path / "record.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match="record.json: expected"):
        read_metrics(path)


def test_a_direction_that_is_none_is_refused(tmp_path):
    """Oracle: the kind of error; `up` is no direction."""
    path = tmp_path / "record.json"
    path.write_text(json.dumps({"metrics": [Metric("m", 1.0, "ratio", "up", 0.1)._asdict()]}))
    with pytest.raises(ConfigError, match="direction"):
        read_metrics(path)


def test_tables_hold_what_was_measured():
    """Oracle: the cells by a parser of Markdown rows, against the rows that went in."""
    found = [[[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()] for text in tables(REPORT).split("\n\n")]
    assert [table[0][0] for table in found] == ["cpu/base/1024", "cpu/base/training", "cpu/stream on a map"]
    assert all(len(cells) == len(table[0]) for table in found for cells in table)
    encode = dict(zip(found[0][0], found[0][3], strict=True))
    assert encode["cpu/base/1024"] == "encode"
    assert (encode["compile ms"], encode["p50 ms"], encode["MFLOP"], encode["gap"]) == ("300.0", "5.00", "5.0", "2.5")
    pair = dict(zip(found[0][0], found[0][5], strict=True))
    assert (pair["p99 ms"], pair["compile ms"]) == ("40.00", "")
    assert found[2][3] == ["total", "25.0", "25.0", "25.0"]


def test_a_quick_run_is_small():
    """Oracle: the first preset, the fewest points."""
    few = suite.quick(suite.Settings(presets=("base", "paper"), points=(1024, 512)))
    assert (few.presets, few.points, few.batched) == (("base",), (512,), False)


@pytest.mark.parametrize(
    ("options", "factor", "code", "words"),
    [
        ([], 1.0, 0, "5 of 5 gates kept"),
        ([], 0.5, 1, "0 of 5 gates kept"),
        (["--quick"], 0.5, 0, "quick run, no verdict"),
    ],
)
def test_the_command_judges_by_the_baseline(options, factor, code, words, tmp_path, monkeypatch, capsys):
    """Oracle: the exit code for a baseline whose values are so many times those of the run."""
    monkeypatch.setattr(suite, "run", lambda settings, note: REPORT)
    path, record = tmp_path / "baseline.json", tmp_path / "record.json"
    path.write_text(
        to_json(REPORT._replace(metrics=[metric._replace(value=factor * metric.value) for metric in METRICS]), quick=False, time="")
    )
    assert main(["bench", "--baseline", str(path), "--json", str(record), *options]) == code
    assert words in capsys.readouterr().out
    assert read_metrics(record) == METRICS


def test_a_gate_that_is_gone_fails(tmp_path, monkeypatch, capsys):
    """Oracle: the exit code for a run that lacks one ratio of its baseline."""
    monkeypatch.setattr(suite, "run", lambda settings, note: REPORT._replace(metrics=METRICS[:-1]))
    path = tmp_path / "baseline.json"
    path.write_text(to_json(REPORT, quick=False, time=""))
    assert main(["bench", "--baseline", str(path)]) == 1
    assert f"not measured: {METRICS[-1].name}" in capsys.readouterr().out


def test_without_a_baseline_there_is_no_verdict(monkeypatch, capsys):
    """Oracle: the exit code, and what was left out by name."""
    left_out = [LeftOut("cpu/paper/4096", "solve needs 9.0 GB, 8.0 GB are free")]
    monkeypatch.setattr(suite, "run", lambda settings, note: REPORT._replace(left_out=left_out))
    assert main(["bench"]) == 0
    said = capsys.readouterr().out
    assert "no baseline, no verdict" in said
    assert "left out: cpu/paper/4096: solve needs 9.0 GB" in said


@pytest.mark.parametrize("options", [["--points", "8"], ["--points"], ["--baseline", "nowhere.json"]])
def test_wrong_options_are_usage_errors(options):
    """Oracle: the exit code of wrong usage."""
    assert main(["bench", *options]) == 2


def test_every_platform_that_is_there_is_measured():
    """Oracle: the devices; the default one comes first, each once, and it is the default only meanwhile."""
    found = suite.platforms()
    assert found[0] == jax.devices()[0].platform
    assert sorted(set(found)) == sorted(found)
    before = jnp.ones(1).devices()
    with suite.on("cpu"):
        assert {device.platform for device in jnp.ones(1).devices()} == {"cpu"}
    assert jnp.ones(1).devices() == before


def test_unknown_numbers_are_left_out():
    """Oracle: by hand; a stage that never ran has no percentiles."""
    never = Row("cpu/stream on a map", "insert", Timing(NOT_BUILT, UNKNOWN, (UNKNOWN, UNKNOWN)))
    assert metrics_of_row(never, MACHINE) == []
