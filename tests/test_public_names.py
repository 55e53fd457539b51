"""What `import delo_jax` offers, and what it costs."""

import subprocess
import sys
import tomllib
from pathlib import Path

import delo_jax

ROOT = Path(__file__).parents[1]
PUBLIC_NAMES = {
    "ConfigError",
    "DatasetError",
    "DeloError",
    "Estimate",
    "Frame",
    "LidarOdometry",
    "Model",
    "Scan",
    "ScanError",
    "WeightsError",
    "__version__",
    "load",
    "odometry",
    "open_dataset",
    "read_scan",
    "save",
}
OWN_MODULES_AT_IMPORT = {"delo_jax", "delo_jax.errors"}


def test_public_names_are_these():
    """Oracle: the list above; a change of it is a change of the interface and belongs in CHANGELOG.md."""
    assert len(delo_jax.__all__) == len(set(delo_jax.__all__))
    assert set(delo_jax.__all__) == PUBLIC_NAMES
    assert set(dir(delo_jax)) >= PUBLIC_NAMES


def test_every_public_name_is_there():
    """Oracle: getattr, which for the lazy ones imports what they need."""
    assert all(getattr(delo_jax, name) is not None for name in PUBLIC_NAMES)
    assert callable(delo_jax.odometry)
    assert not hasattr(delo_jax, "no_such_name")


def test_bare_import_is_light():
    """Oracle: the modules of a fresh interpreter; no jax, no flax, no matplotlib, not even numpy."""
    code = "import sys; before = set(sys.modules); import delo_jax; print(*sorted(set(sys.modules) - before))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    own = {name for name in loaded if name.split(".")[0] == "delo_jax"}
    assert own == OWN_MODULES_AT_IMPORT
    assert not {name.split(".")[0] for name in loaded - own} - set(sys.stdlib_module_names)


def test_version_is_that_of_the_project():
    """Oracle: pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert delo_jax.__version__ == project["version"]
