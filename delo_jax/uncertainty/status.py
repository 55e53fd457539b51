"""Health status of a pair."""

from typing import NamedTuple

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.observability import Observability

STATUSES = ("ok", "low_confidence", "degenerate", "rejected")


class Health(NamedTuple):
    """Status, why, and how sure the network is that the pair is not lost."""

    status: str  # one of STATUSES
    reason: str  # empty when ok
    confidence: float  # in [0, 1]


def judge(
    *,
    num_points: tuple[int, int],
    finite: bool,
    confidence: float | None,
    seen: Observability,
    cfg: StatusConfig,
) -> Health:
    """Status of a solved pair; the worst that applies.

    Args:
        num_points: usable points of source and target.
        finite: whether the solver found a pose.
        confidence: probability that the pair is not lost; None where the network says nothing of it, which is never `ok`.
        seen: how well the surfaces hold each direction.
        cfg: thresholds.
    """
    if min(num_points) < cfg.min_points:
        which = "source" if num_points[0] <= num_points[1] else "target"
        return Health("rejected", f"{which} has {min(num_points)} usable points, fewer than {cfg.min_points}", 0.0)
    if not finite:
        return Health("rejected", "the solver found no pose: its matches determine none", 0.0)
    known = 0.0 if confidence is None else confidence
    if confidence is not None and confidence < cfg.rejected_confidence:
        return Health("rejected", f"confidence {confidence:.2f} is below {cfg.rejected_confidence:g}", confidence)
    if seen.shares[0] < cfg.min_observability:
        axes = ", ".join(seen.unheld_axes(cfg.min_observability))
        reason = f"hardly any surface holds {axes} ({max(seen.shares[0], 0.0):.5f} is below {cfg.min_observability:g})"
        return Health("degenerate", reason, known)
    if confidence is None:
        return Health("low_confidence", "this network has no evidence head: nothing says how far its pose can be trusted", 0.0)
    if confidence < cfg.ok_confidence:
        return Health("low_confidence", f"confidence {confidence:.2f} is below {cfg.ok_confidence:g}", confidence)
    return Health("ok", "", confidence)
