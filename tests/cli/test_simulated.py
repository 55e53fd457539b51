import csv
import json
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from delo_jax import sim, weights
from delo_jax.cli import doctor
from delo_jax.data import open_dataset
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.sim.drive import DRIVE_SEED
from delo_jax.train.validate import GapErrors
from tests.report.pages import page_data

WITHOUT_SOCKETS = """
import sys

def refuse(event, _):
    if event.startswith("socket."):
        raise SystemExit(f"opened {event}")

sys.addaudithook(refuse)
from delo_jax.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_demo_opens_no_socket(weights_file, tmp_path):
    """Oracle: an audit hook of a fresh interpreter that sees every socket; the simulator's truth is beside the estimate."""
    out = tmp_path / "demo"
    argv = ["demo", "--out", str(out), "--num-scans", "5", "--weights", weights_file]
    run = subprocess.run([sys.executable, "-W", "error", "-c", WITHOUT_SOCKETS, *argv], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "error of a step" in run.stdout
    assert "status" in run.stdout
    for name in ("trajectory.png", "scene.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert json.loads((out / "run.json").read_text())["sensor"]["deskew"] == "done"
    with (out / "frames.csv").open(newline="") as file:
        assert {"simulate_ms", "prepare_ms", "solve_ms"} <= set(next(csv.DictReader(file)))
    estimate, truth = np.loadtxt(out / "trajectory.tum"), np.loadtxt(out / "truth.tum")
    assert len(estimate) == len(truth) == 5
    np.testing.assert_allclose(np.transpose(page_data(out)["truth"]), truth[:, 1:4], atol=1e-3)
    np.testing.assert_array_equal(estimate[:, 0], truth[:, 0])
    drive = list(sim.simulate_drive("urban", DRIVE_SEED + 63, 5, rolling_shutter=True))
    T_first_last = np.linalg.inv(drive[0].T_world_lidar) @ drive[-1].T_world_lidar
    np.testing.assert_allclose(truth[-1, 1:4], T_first_last[:3, 3], atol=1e-8)


def test_demo_spares_another_run(cli, tmp_path):
    """Oracle: the bytes of what was there."""
    (tmp_path / "run.json").write_text('{"dataset": {"name": "mine"}}')
    done = cli("demo", "--out", tmp_path)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_simulated_tree_is_read_back(tree):
    """Oracle: the simulator, called by hand with the same arguments; files hold float32 and 13 digits."""
    dataset = open_dataset(tree)
    drive = list(sim.simulate_drive("mixed", DRIVE_SEED + int(dataset.name.removeprefix("mixed-")), len(dataset)))
    assert dataset.compensated is True
    assert dataset.elevation_correction_deg == 0.0
    np.testing.assert_array_equal(dataset[2].points, drive[2].points)
    T_first_last = np.linalg.inv(drive[0].T_world_lidar) @ drive[-1].T_world_lidar
    np.testing.assert_allclose(dataset.truth[-1], T_first_last, atol=1e-9)
    np.testing.assert_array_equal(dataset.stamps_ns, FRAME_PERIOD_NS * np.arange(len(dataset)))


def test_simulate_rolling_shutter_and_refuses_to_overwrite(cli, tmp_path):
    """Oracle: the command that it prints, given to the parser, and the scans of the first call."""
    done = cli("simulate", tmp_path, "--drive", "residential", "--num-scans", "2", "--seed", "5", "--rolling-shutter")
    assert done.code == 0
    assert "exact, in poses/residential-5.txt" in done.out
    assert len((tmp_path / "poses" / "residential-5.txt").read_text().splitlines()) == 2
    command = re.search(r"delo (run .*)", done.out)[1].split()
    assert command == ["run", str(tmp_path), "--sequence", "residential-5"]
    assert cli(*command, "--dump-config").code == 0
    dataset = open_dataset(tmp_path)
    assert (dataset.compensated, dataset.point_times) == (False, "azimuth")
    drive = next(iter(sim.simulate_drive("residential", DRIVE_SEED + 5, 2, rolling_shutter=True)))
    late_s = (dataset[0].times - drive.times_s + 0.05) % 0.1 - 0.05  # right behind, a sweep begins and ends
    np.testing.assert_allclose(late_s, 0.0, atol=1e-3)  # a column of beams is wider than a line
    again = cli("simulate", tmp_path, "--drive", "residential", "--num-scans", "2", "--seed", "5")
    assert (again.code, again.err.count("\n")) == (2, 1)


@pytest.mark.parametrize("seed", [-1, 500_000, 1_000_000])
def test_simulate_keeps_to_its_own_seeds(seed, cli, tmp_path):
    """Oracle: the sentence; nothing is written."""
    done = cli("simulate", tmp_path / "out", f"--seed={seed}")
    assert (done.code, done.out) == (2, "")
    assert done.err == f"delo: seed: expected 0 to 499999, whose worlds training never uses, got {seed}\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("bound_cm", "state"), [(50.0, "ok"), (0.0, "problem")])
def test_doctor(bound_cm, state, cli, monkeypatch):
    """Oracle: bounds of the self-test that untrained weights keep or cannot keep, and the files in the folder of released weights."""
    monkeypatch.setattr(doctor, "BOUND_CM", bound_cm)
    monkeypatch.setattr(doctor, "BOUND_DEG", 5.0)
    done = cli("doctor")
    states = {
        row[1].strip(): row[3].strip() for row in (line.split("│") for line in done.out.splitlines()) if len(row) == 6 and row[3].strip()
    }
    self_test = next(name for name in states if name.startswith("self-test"))  # a narrow table breaks the rest of the name off
    assert states.pop(self_test) == state
    if not weights.released():
        assert states.pop("released weights") == "problem"
    assert set(states.values()) == {"ok"}
    assert done.code == int("problem" in done.out)


def test_doctor_without_weights(cli):
    """Oracle: a name that no weights have."""
    done = cli("doctor", "--weights", "nope")
    assert done.code == 1
    assert "not run" in done.out


def test_train(cli, monkeypatch, tmp_path, weights_file):
    """Oracle: a training that is told by hand: bars, tables, card and weights are those of its answer."""
    errors = [GapErrors(1, 40, 1.5, 4.5, 0.02, 0.025, 0.0, 0.0)]

    def learn(cfg, out, reporter, data):
        assert data is None
        reporter.start("learning poses", 2)
        reporter.advance("loss 1.000")
        reporter.validated(1, errors)
        reporter.advance("loss 0.500")
        return weights.load(weights_file), errors, 3

    monkeypatch.setitem(sys.modules, "delo_jax.train.loop", SimpleNamespace(train=learn))
    done = cli("train", "base", "--out", tmp_path)
    assert done.code == 0
    assert "unseen worlds after 1 steps" in done.out
    assert "loss 0.500" in done.err
    card = weights.read_card(tmp_path / "delo-base.safetensors")
    assert card["license"] == "MIT"
    assert card["metrics"][0]["lost_share"] == 0.025
    assert card["steps left out as not finite"] == 3
    assert card["commands"] == [f"delo train base --out {tmp_path}"]
    assert card["seeds"] == {"base": 0, "validation": "worlds from seed 1000000 on, never trained on"}
    weights.load(tmp_path / "delo-base.safetensors")


def test_train_interrupted_says_how_to_go_on(cli, monkeypatch, tmp_path):
    """Oracle: the same command line."""

    def interrupt(cfg, out, reporter, data):
        raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "delo_jax.train.loop", SimpleNamespace(train=interrupt))
    monkeypatch.chdir(tmp_path)
    for options in ("", f" --out {tmp_path}"):
        done = cli("train", "base", *options.split())
        assert done.code == 1
        assert done.err.strip().endswith(f"to go on: delo train base{options}")
