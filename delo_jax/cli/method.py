"""What follows the scans of a run: this package's odometry, or another method's."""

import time
from typing import Any, NamedTuple

from delo_jax import weights
from delo_jax.baselines.icp import Icp, PointToPlane
from delo_jax.baselines.registry import METHODS, Method
from delo_jax.cli.console import parts
from delo_jax.errors import ConfigError
from delo_jax.model.delo import Model
from delo_jax.pipeline.baseline_odometry import BaselineOdometry
from delo_jax.pipeline.compiled import compile_odometry, functions
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.uncertainty import stream


class Opened(NamedTuple):
    """A method, ready for the first scan."""

    odometry: LidarOdometry | BaselineOdometry
    params: Model | None
    """Weights, of a method that has some."""
    compile_s: float
    facts: dict[str, Any]
    """What run.json says about it."""


def check_options(method: Method, *, given_weights: str | None, given_map: str | None, refine: bool) -> None:
    """Looks whether a method can run with these options, before anything is opened.

    Raises:
        ConfigError: options that mean nothing to it, a missing package, or no weights where it needs some.
    """
    if method.name == "delo":
        return
    if given_weights is not None and not method.network:
        raise ConfigError(f"--weights: expected a method with a network, got --method {method.name}, which has none; leave it out")
    if given_weights is None:
        method.check()
    if given_map is not None:
        raise ConfigError(f"--map {given_map}: expected --method delo, got {method.name}, which has its own map or none; leave it out")
    if refine:
        why = "whose graph weighs motions by their covariances"
        raise ConfigError(f"--refine: expected --method delo, {why}, got {method.name}; leave it out")


def open_method(name: str, *, weights_name: str | None, use_map: bool, deskew: bool, stamp_sigma_s: float) -> Opened:
    """A method by name, compiled where it is compiled.

    Raises:
        DeloError: weights that cannot be used, or a missing package.
    """
    method = METHODS[name]
    params, card = None, None
    if weights_name is not None:
        params, card = weights.load(weights_name), {"name": weights_name, "sha256": weights.read_card(weights_name)["sha256"]}
    method.check(params)
    compile_s = _compile(method, params, use_map=use_map)
    odometry: LidarOdometry | BaselineOdometry
    if params is not None and method.tracker is None:
        odometry = LidarOdometry(params, use_map=use_map, deskew=deskew, stamp_sigma_s=stamp_sigma_s)
    else:
        odometry = BaselineOdometry(method.open_tracker(params), deskew=deskew)
    facts = {
        "method": name,
        "weights": card,
        "uncertainty": _uncertainty(method, params, use_map=use_map),
        "same_bytes_again": method.deterministic,
        "compile_s": round(compile_s, 3),
    }
    return Opened(odometry, params, compile_s, facts)


def package_versions(name: str) -> dict[str, str | None]:
    """Of the package that a method is from, if it is from another."""
    method = METHODS[name]
    return {} if method.package is None else {method.package: method.package_version}


def _compile(method: Method, params: Model | None, *, use_map: bool) -> float:
    """Compiles what is compiled, behind a bar; the time it took [s]."""
    if params is not None:
        with parts("compiling", len(functions(params, use_map=use_map))) as begins:
            return compile_odometry(params, use_map=use_map, begins=begins)
    begin = time.perf_counter()
    if method.pair in (Icp, PointToPlane):
        with parts("compiling", 1) as begins:
            begins("step")
            method.pair().compile()
        return time.perf_counter() - begin
    return 0.0


def _uncertainty(method: Method, params: Model | None, *, use_map: bool) -> str:
    """Where the covariances are from."""
    if params is None or not method.uncertainty:
        return f"none: {method.name} does not say how sure it is; covariances, sigmas and confidence are NaN"
    calibrated = stream.NAME in params.variables if use_map else params.cfg.evidence.covariance_width > 0
    source = "fitted on simulated " + ("drives" if use_map else "pairs")
    return source if calibrated else f"{'information matrix' if use_map else 'evidence head'}, not calibrated"
