import os
import pathlib
import re
import subprocess
import sys
import tomllib
import typing

import pytest

import delo_jax.cli
from delo_jax import config, sim
from delo_jax.cli import COMMANDS, main
from delo_jax.cli.simulate import Kind, SensorName

HEAVY = {"jax", "scipy", "matplotlib", "gtsam", "flax", "orbax"}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_an_example_that_works(name, cli):
    """Oracle: the parser on the example itself, and the standard library's TOML parser on what --dump-config prints."""
    done = cli(name, "--help")
    example = re.search(r"Example: delo (.*)", COMMANDS[name].__doc__)[1].split()
    assert done.code == 0
    assert f"Example: delo {name}" in done.out
    dumped = cli(*example, "--dump-config")
    assert dumped.code == 0
    assert "dump_config" not in tomllib.loads(dumped.out)


def test_help_imports_nothing_heavy():
    """Oracle: the modules of a fresh interpreter."""
    code = "import sys; from delo_jax.cli import main; main(['run', '--help']); print('MODULES', *sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in run.stdout.split("MODULES")[1].split()}
    assert not loaded & HEAVY


def test_module_is_the_command():
    """Oracle: the exit code and the first line of the help of `python -m delo_jax`."""
    run = subprocess.run([sys.executable, "-m", "delo_jax", "--help"], capture_output=True, text=True, check=False)
    assert run.returncode == 0
    assert run.stdout.startswith("usage: delo ")


def test_choices_are_those_of_the_simulator():
    """Oracle: the simulator's own tables; the command line repeats them, to not import them for --help."""
    assert typing.get_args(Kind) == sim.KINDS
    assert set(typing.get_args(SensorName)) == set(sim.SENSORS)


def test_options_in_toml(cli):
    """Oracle: the standard library's TOML parser; a path may hold quotes, backslashes and line breaks."""
    done = cli("run", 'a "b"\\c\nd', "--deskew", "off", "--dump-config", "--weights", "w")
    expected = {"path": 'a "b"\\c\nd', "weights": "w", "map": "local", "deskew": "off", "no_elevation_correction": False}
    assert tomllib.loads(done.out) == expected | {"method": "delo", "refine": False, "stamp_sigma_ms": 1.0}


def test_training_options_can_be_trained_with(cli, tmp_path):
    """Oracle: the config read back."""
    (tmp_path / "my.toml").write_text(cli("train", "base", "--dump-config").out)
    assert config.load(config.TrainConfig, tmp_path / "my.toml") == config.TrainConfig()
    again = cli("train", tmp_path / "my.toml", "--dump-config")
    assert again.out == (tmp_path / "my.toml").read_text()


@pytest.mark.parametrize("argv", [[], ["nonsense"], ["run"], ["run", "x", "--deskew", "maybe"], ["simulate", "x", "--num-scans", "many"]])
def test_usage_errors(argv, capfd):
    """Oracle: exit code 2 by convention, and stderr alone speaks."""
    assert main(argv) == 2
    out, err = capfd.readouterr()
    assert not out
    assert err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["run", "/no/such/folder"], "/no/such/folder: expected a folder of scans"),
        (["eval", "/no/such/folder"], "/no/such/folder: expected the folder of a run"),
        (["train", "bass"], "bass: expected a preset"),
        (["simulate", "x", "--num-scans", "0"], "num_scans: expected at least 1"),
        (["demo", "--num-scans", "1"], "num_scans: expected at least 2"),
        (["run", ".", "--weights", "nope"], "expected"),
    ],
)
def test_bad_input_is_one_sentence(argv, words, cli, monkeypatch, tmp_path):
    """Oracle: the sentence, and exit code 2."""
    monkeypatch.chdir(tmp_path)
    done = cli(*argv)
    assert done.code == 2
    assert done.err.startswith("delo: ")
    assert done.err.count("\n") == 1
    assert words in done.err


def test_the_unexpected_is_one_sentence_too(monkeypatch, cli):
    """Oracle: an error raised on purpose; DELO_DEBUG=1 shows it whole."""

    def fail(self):
        raise RuntimeError("the moon\nis full")

    monkeypatch.setattr(delo_jax.cli.Doctor, "run", fail)
    done = cli("doctor")
    assert (done.code, done.out) == (1, "")
    assert done.err == "delo: unexpected RuntimeError: the moon is full; set DELO_DEBUG=1 for the traceback\n"
    monkeypatch.setenv("DELO_DEBUG", "1")
    with pytest.raises(RuntimeError, match="the moon"):
        main(["doctor"])


def test_interrupted_anywhere(monkeypatch, cli):
    """Oracle: exit code 1 and one word for a Ctrl-C outside of a loop over scans."""

    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(delo_jax.cli.Doctor, "run", interrupt)
    assert cli("doctor") == (1, "", "delo: interrupted\n")


def test_the_first_pose_waits_for_neither_figures_nor_graphs():
    """Oracle: the interpreter's own list of what is imported, in a process that has everything before the first scan."""
    code = "import sys, delo_jax.baselines.registry, delo_jax.cli.tracking, delo_jax.data.dataset; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in run.stdout.split()}
    assert "jax" in loaded
    assert not {"gtsam", "matplotlib", "optimistix", "orbax"} & loaded


def test_compiled_code_is_kept_for_the_next_start(monkeypatch, tmp_path):
    """Oracle: JAX's own variables, in the user's cache folder; those that are set stand, and no folder is no error."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, "")  # so that what is set below is undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    delo_jax.cli.keep_compiled()
    folder = pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert folder.is_dir()
    assert folder.parent == tmp_path / "delo-jax"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    delo_jax.cli.keep_compiled()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "elsewhere"
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    delo_jax.cli.keep_compiled()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_second_start_compiles_nothing(tmp_path):
    """Oracle: JAX's own events: what the first process compiled, the second one reads."""
    code = """if True:
        from delo_jax.cli import keep_compiled
        keep_compiled()
        import jax
        misses = []
        jax.monitoring.register_event_listener(lambda event, **_: misses.append(event) if event.endswith("cache_misses") else None)
        import numpy as np
        import delo_jax
        scan = np.random.default_rng(0).uniform(-20.0, 20.0, (2000, 3))
        delo_jax.odometry(delo_jax.load("delo-base"), scan, scan)
        print("MISSES", len(misses))
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"  # all of it, however fast the machine compiles
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment) for _ in range(2)]
    first, second = (int(run.stdout.split("MISSES")[1]) for run in runs)
    assert first >= 2
    assert second == 0
