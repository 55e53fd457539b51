import sys
import typing

import numpy as np
import pytest

from delo_jax.baselines.registry import METHODS
from delo_jax.cli import main
from delo_jax.cli.run import Method
from delo_jax.errors import ConfigError
from delo_jax.model.delo import Model
from delo_jax.train.presets import PRESETS

WHOLE_ONLY = {"kiss-icp", "genz-icp"}
LIDAR_ODOMETRY = {"delo", "delo-paper"}
BASE = Model({}, PRESETS["base"].model)  # nothing of it is looked at but the preset
WITH_PACKAGE = {name for name, method in METHODS.items() if method.package}


def test_the_command_line_lists_them_all(capfd):
    """Oracle: the choices of `delo run`, which repeats the names, to not import them for --help, and what the help prints."""
    assert typing.get_args(Method) == tuple(METHODS)
    assert main(["run", "--help"]) == 0
    text = capfd.readouterr().out
    assert all(name in text for name in METHODS)


def test_every_method_has_its_protocols():
    """Oracle: which of them are whole odometries only, and which are this package's own."""
    assert {name for name, method in METHODS.items() if method.pair is None} == WHOLE_ONLY
    assert {name for name, method in METHODS.items() if method.tracker is None} == LIDAR_ODOMETRY
    assert {name for name, method in METHODS.items() if method.uncertainty} == LIDAR_ODOMETRY
    assert all(method.what for method in METHODS.values())
    with pytest.raises(ConfigError, match="one for whole drives"):
        METHODS["kiss-icp"].open_pair()
    with pytest.raises(ConfigError, match="LidarOdometry"):
        METHODS["delo"].open_tracker(BASE)


@pytest.mark.parametrize("name", sorted(WITH_PACKAGE))
def test_a_missing_package_is_one_sentence(name, monkeypatch):
    """Oracle: an import that fails as that of a package which is not there."""
    package = METHODS[name].package
    monkeypatch.setitem(sys.modules, package.replace("-", "_"), None)
    sentence = f"--method {name}: expected the package {package}, got none; pip install 'delo-jax[baselines]'"
    with pytest.raises(ConfigError) as refused:
        METHODS[name].open_tracker()
    assert str(refused.value) == sentence


@pytest.mark.parametrize("name", ["dcp", "delo-paper"])
def test_presets_want_their_own_weights(name):
    """Oracle: no weights, and those of another preset."""
    with pytest.raises(ConfigError, match=r"expected weights trained by `delo train .*--weights FILE"):
        METHODS[name].open_pair()
    with pytest.raises(ConfigError, match="got the preset base"):
        METHODS[name].open_pair(BASE)


@pytest.mark.parametrize("name", sorted(set(METHODS) - LIDAR_ODOMETRY - WITH_PACKAGE - {"dcp"}))
def test_what_needs_nothing_opens(name):
    """Oracle: the protocols' own methods."""
    assert callable(METHODS[name].open_tracker().track)
    assert METHODS[name].package_version is None
    assert METHODS[name].open_pair()(np.zeros((0, 3)), np.zeros((0, 3))).status == "rejected"
