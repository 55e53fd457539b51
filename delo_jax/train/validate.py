"""Errors on worlds that training never saw, through the very functions that inference uses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from delo_jax import inference
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.train.worlds import World, scan_of

GAPS = (1, 2, 3, 5)


class GapErrors(NamedTuple):
    """Registration from identity at one frame gap."""

    gap: int
    num_pairs: int
    median_cm: float
    p95_cm: float
    median_deg: float
    lost_share: float  # off by more than the config's limits
    false_alarm_share: float  # of the pairs not lost: confidence below ok; NaN without an evidence head
    missed_share: float  # of the lost pairs: confidence ok; NaN without an evidence head


def validate(model: delo.Model, worlds: list[World]) -> list[GapErrors]:
    """Errors at gaps 1, 2, 3 and 5, as far as the worlds go, no motion prior, from every fifth frame of every world."""
    rows = []
    gaps = [gap for gap in GAPS if gap < min(len(world.Ts_world_lidar) for world in worlds)]
    limits, judges = model.cfg.status, model.cfg.evidence.head != "none"
    errors_of: dict[int, list] = {gap: [] for gap in gaps}
    for world in worlds:
        for first in range(0, len(world.Ts_world_lidar) - gaps[-1], gaps[-1]):
            encoded = [inference.encode(model, scan_of(world, first + step, model.cfg.preprocess)) for step in (0, *gaps)]
            for gap, target in zip(gaps, encoded[1:], strict=True):
                result = jax.device_get(inference.solve(model, encoded[0], target, jnp.eye(4)))
                T_true = se3.inverse(world.Ts_world_lidar[first + gap]) @ world.Ts_world_lidar[first]
                error = se3.inverse(np.asarray(result.T_target_source, np.float64)) @ T_true
                errors_of[gap].append((np.linalg.norm(error[:3, 3]), se3.rotation_angle(error[:3, :3]), result.confidence))
    for gap, errors in errors_of.items():
        translation, rotation, confidence = np.array(errors, np.float64).T
        lost = ~((translation <= limits.lost_translation_m) & (rotation <= np.radians(limits.lost_rotation_deg)))
        ok = confidence >= limits.ok_confidence
        rows.append(
            GapErrors(
                gap,
                len(errors),
                100 * float(np.median(translation)),
                100 * float(np.percentile(translation, 95)),
                float(np.degrees(np.median(rotation))),
                float(lost.mean()),
                float((~ok & ~lost).sum() / max((~lost).sum(), 1)) if judges else np.nan,
                float((ok & lost).sum() / max(lost.sum(), 1)) if judges else np.nan,
            )
        )
    return rows
