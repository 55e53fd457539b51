"""A road dressed chunk by chunk: what stands on the verge, what drives on it, what lines it."""

import numpy as np

from delo_jax.sim import objects
from delo_jax.sim.fronts import lay_cross_street, lay_front, places
from delo_jax.sim.primitives import Builder
from delo_jax.sim.style import Lane, Style

CHUNK_M = 50.0


def lay_chunk(b: Builder, style: Style, x0: float, x1: float) -> None:
    """Dress the road from x0 to x1."""
    rng = b.rng
    cross = None
    if rng.uniform() < style.cross_street_chance:
        middle, half = rng.uniform(x0 + 10.0, x1 - 10.0), rng.uniform(3.0, 8.0)
        cross = (middle - half, middle + half)
    if style.median_rail:
        oncoming = [lane.y for lane in style.lanes if lane.oncoming]
        own = [0.0] + [lane.y for lane in style.lanes if not lane.oncoming]
        objects.guard_rail(b, x0, x1, 0.5 * (min(oncoming) + max(own)))
    if style.kind == "road" and rng.uniform() < 0.15:
        objects.gantry(b, rng.uniform(x0, x1), style.right_edge - 1.0, style.left_edge + 1.0)
    if rng.uniform() < {"road": 0.08, "mixed": 0.05, "open": 0.03}.get(style.kind, 0.0):
        objects.bridge(b, rng.uniform(x0, x1), style.right_edge - 1.0, style.left_edge + 1.0)
    for side in (1.0, -1.0):
        one_sided = rng.uniform() < 0.4
        stretches = [(x0, x1)] if cross is None or one_sided else [(x0, cross[0]), (cross[1], x1)]
        for start, end in stretches:
            _verge(b, style, side, start, end)
            while end - start > 1.0:
                stop = min(end, start + rng.uniform(12.0, 50.0))
                stop = end if end - stop < 8.0 else stop
                lay_front(b, style, side, start, stop)
                start = stop
        if cross is not None and not one_sided:
            lay_cross_street(b, style, side, *cross)


def lay_traffic(b: Builder, style: Style, lane: Lane, x0: float, x1: float) -> None:
    """The vehicles of one lane that are between x0 and x1 at time 0, all equally fast."""
    x = x0 + 8.0 + b.rng.exponential(style.traffic_gap)
    while x < x1 - 8.0:
        objects.car(b, x, lane.y + b.rng.normal(0.0, 0.15), np.pi if lane.oncoming else 0.0, lane.speed, lorries=True)
        x += 16.0 + b.rng.exponential(style.traffic_gap)


def _verge(b: Builder, style: Style, side: float, x0: float, x1: float) -> None:
    """Between the road's edge and the fronts: parked cars, kerb, poles, trees, people, clutter, rails."""
    rng = b.rng
    edge, front = (style.left_edge, style.left_front) if side > 0 else (-style.right_edge, -style.right_front)
    depth = style.parking_depths[0 if side > 0 else 1]
    if depth > 0.0:
        x, step, turn = x0 + rng.uniform(2.0, 6.0), 5.2 if depth < 3.0 else 2.6, 0.5 * np.pi * (depth > 3.0)
        while x < x1 - 3.0:
            if rng.uniform() < style.parking:
                yaw = float(rng.choice([0.0, np.pi])) + rng.normal(0.0, 0.02) + turn
                objects.car(b, x, side * (edge - 0.5 * depth + 0.05 + rng.normal(0.0, 0.08)), yaw, lorries=depth < 3.0)
            x += step * rng.uniform(1.0, 1.4)
    if style.kerb_height:
        near, far = side * edge, side * (front + 0.1)
        objects.slab(b, x0, x1, min(near, far), max(near, far), style.kerb_height)
    inside = max(edge + 0.3, front - 0.4)
    if rng.uniform() < style.rail_chance:
        objects.guard_rail(b, x0, x1, side * (edge + rng.uniform(0.0, 0.5)))
    row, tree_row = edge + rng.uniform(0.3, 0.8), edge + rng.uniform(0.6, 1.5)
    for x in np.arange(x0 + rng.uniform(0.0, style.pole_gap), x1, style.pole_gap):
        objects.pole(b, x, side * row, -side)
    for x in np.arange(x0 + rng.uniform(0.0, style.tree_gap), x1, style.tree_gap):
        objects.tree(b, x + rng.normal(0.0, 0.5), side * tree_row, style.tree_size * rng.uniform(0.5, 1.1), clear_m=rng.uniform(1.5, 3.0))
    for x in places(rng, x0, x1, style.people_gap):
        objects.pedestrian(b, x, side * rng.uniform(edge + 0.2, inside), rng.uniform(0.3, 1.8) * (rng.uniform() < 0.8))
    for x in places(rng, x0, x1, style.clutter_gap):
        objects.clutter(b, x, side * rng.uniform(edge + 0.3, inside))
