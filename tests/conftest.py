"""What every test runs under: JAX on the CPU, no rank promotion, shapes checked, warnings as errors (in `pyproject.toml`).

DELO_DATA=DIR          a KITTI-like tree of real scans; tests marked `data` skip without it
DELO_REQUIRE_DATA=1    a `data` test that skips is a failure (continuous integration)
DELO_TEST_GPU=1        leave the choice of device to JAX; tests marked `gpu` skip without it

Compiled code is kept in a temporary folder that all processes of a run share, and the next run finds again.
"""

import os
import tempfile
from pathlib import Path

if not os.environ.get("DELO_TEST_GPU"):
    os.environ["JAX_PLATFORMS"] = "cpu"  # read once, when JAX starts
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "delo-jax-tests"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import hypothesis
import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("delo_jax", "beartype.beartype")  # before the first import of delo_jax
jax.config.update("jax_numpy_rank_promotion", "raise")
hypothesis.settings.register_profile("delo", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("delo")

TESTS = Path(__file__).parent
STRICT_DTYPE_FOLDERS = tuple(TESTS / name for name in ("geometry", "ops", "sim"))


def pytest_collection_modifyitems(items):
    """Adds the skips of `data` and `gpu` tests, each with one sentence that says what to set."""
    for item in items:
        if item.get_closest_marker("data") and not os.environ.get("DELO_DATA"):
            item.add_marker(pytest.mark.skip(reason="needs real scans: set DELO_DATA to a KITTI-like tree"))
        if item.get_closest_marker("gpu") and not os.environ.get("DELO_TEST_GPU"):
            item.add_marker(pytest.mark.skip(reason="needs an accelerator: set DELO_TEST_GPU=1"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Turns a skipped `data` test into a failure where the data has to be there."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail") and item.get_closest_marker("data") and os.environ.get("DELO_REQUIRE_DATA"):
        report.outcome, report.longrepr = "failed", f"{item.nodeid} skipped although DELO_REQUIRE_DATA is set: {report.longrepr}"
    return report


@pytest.fixture(autouse=True)
def _strict_dtypes(request):
    """Geometry, formulas and simulator take no implicit dtype promotion; optax does not run under it."""
    if not any(folder in request.path.parents for folder in STRICT_DTYPE_FOLDERS):
        yield
        return
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture
def data_dir() -> Path:
    """Root of the tree of real scans; use it in tests marked `data`."""
    root = Path(os.environ["DELO_DATA"])
    assert root.is_dir(), f"DELO_DATA: expected a folder, got {root}"
    return root
