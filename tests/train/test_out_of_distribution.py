"""Doubt of the released weights away from what they were trained on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import delo_jax
from delo_jax import inference
from delo_jax.preprocess import preprocess
from delo_jax.sim import simulate_clip
from delo_jax.train.worlds import SENSORS
from delo_jax.uncertainty import covariance

UNSEEN_SEED = 1_690_000
OTHER_SENSOR = "vlp16"


@pytest.mark.slow
def test_doubt_grows_with_the_beams_of_another_sensor():
    """Oracle: the construction. The same worlds and motions, seen by a sensor that training never used: a larger epistemic variance."""
    assert OTHER_SENSOR not in SENSORS
    model = delo_jax.load()
    variances: dict[str, list[np.ndarray]] = {sensor: [] for sensor in ("hdl64e", OTHER_SENSOR)}
    for sensor, found in variances.items():
        for number, kind in enumerate(("urban", "residential", "mixed", "open")):
            clip = simulate_clip(kind, UNSEEN_SEED + number, num_frames=3, sensor=sensor)
            encodings = [inference.encode(model, preprocess(scan.points, model.cfg.preprocess)) for scan in clip]
            for target in (1, 2):
                result = inference.solve(model, encodings[0], encodings[target], jnp.eye(4))
                half, doubt = jax.device_get(inference.pair_covariance(model, result))
                found.append(covariance.from_half(np.asarray(half, np.float64), float(doubt)).epistemic)
    usual, other = (np.median(found, axis=0) for found in variances.values())
    assert np.mean(other / usual) > 1.5
