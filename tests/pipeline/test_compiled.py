"""Ahead-of-time compilation: nothing is left to compile on the way."""

import dataclasses

import jax
import numpy as np
import pytest

from delo_jax.errors import ConfigError
from delo_jax.model.delo import Model
from delo_jax.pipeline.compiled import compile_odometry, functions
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from tests.fixtures import narrow_model
from tests.pipeline.test_scan_to_map import sweep, weights

BUILT = "/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def built():
    """What JAX traces and compiles, in order."""
    found = []

    def note(event, duration_secs, **words):
        if event in BUILT:
            found.append(words.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    jax.monitoring.unregister_event_duration_listener(note)


def sized(num_points: int) -> Model:
    """The released weights for scans of a size that no other test compiles for."""
    cfg = weights().cfg
    return Model(weights().variables, dataclasses.replace(cfg, preprocess=dataclasses.replace(cfg.preprocess, max_points=num_points)))


def odd_drive():
    """Scans of many sizes and their times; the fifth is empty, the eighth is noise, the ninth has no times."""
    rng = np.random.default_rng(0)
    for k in range(12):
        points = sweep(k)
        points = points[rng.uniform(size=len(points)) >= rng.uniform(0.0, 0.9)]
        if k == 5:
            points = points[:0]
        if k == 8:
            points = rng.uniform(-40.0, 40.0, points.shape).astype(np.float32)
        yield points, None if k == 9 else np.full(len(points), 1e-3)


@pytest.mark.parametrize(("use_map", "num_points"), [(True, 2991), (False, 2993)])
def test_a_stream_compiles_nothing_on_the_way(built, use_map, num_points):
    """Oracle: JAX's own events, which name every function before the first scan, and none after it, a recovery or an empty scan among
    them; the frames themselves tell that those took place.
    """
    odometry = LidarOdometry(sized(num_points), use_map=use_map)
    assert odometry.compile() > 0.0
    pair = {"encode", "solve", "covariance"}
    assert set(built) >= (pair | {"fine_step", "robust_point_to_plane", "robust_sweep_to_plane"} if use_map else pair)
    assert ("fine_step" in built) == use_map
    built.clear()
    frames = [odometry.register(points, None, times_s) for points, times_s in odd_drive()]
    assert built == []
    statuses = [frame.status for frame in frames]
    assert statuses[5] == statuses[8] == "rejected"
    assert statuses[-1] == "ok"


def test_every_function_is_told_by_name():
    """Oracle: the list that `functions` gives; without a fine stage there is no map to compile for."""
    params, names = narrow_model("paper"), list[str]()
    compile_odometry(params, use_map=False, begins=names.append)
    assert names == [part.name for part in functions(params, use_map=False)] == ["encoder", "solver", "covariance"]
    with pytest.raises(ConfigError, match="fine stage"):
        functions(params, use_map=True)
