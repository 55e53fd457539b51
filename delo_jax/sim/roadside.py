"""The cross-section of a road and what lines it, chunk by chunk."""

from typing import NamedTuple

import numpy as np

from delo_jax.sim import buildings, objects
from delo_jax.sim.primitives import Builder

CHUNK_M = 50.0

# Odds of what lines a stretch of road: facades, houses, walls, hedges, fences, parking lots, parks, fields,
# rows of trees, bushes, noise walls.
FRONTS = ("facades", "houses", "wall", "hedge", "fence", "parking", "park", "field", "treeline", "bushes", "noise_wall")
ODDS = {
    "urban": (12, 1, 1, 0.3, 0.5, 1, 1.5, 0, 0.7, 0.3, 0),
    "residential": (2, 12, 1, 1.5, 1, 0.5, 1, 0.5, 0.7, 0.7, 0),
    "mixed": (2, 3, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 0.7),
    "road": (0.5, 0.5, 0.5, 0.3, 1, 0.5, 0.5, 4, 2.5, 2.5, 2.5),
    "open": (0, 0, 0, 0, 0.7, 0, 0.3, 3, 3, 3.5, 0),
}


class Style(NamedTuple):
    """What a drive's road looks like; y of the edges as seen from the vehicle's lane."""

    kind: str
    odds: tuple[float, ...]
    left_edge: float
    right_edge: float
    left_front: float
    """Where private ground begins; between edge and front lie parking and sidewalk."""
    right_front: float
    lanes: tuple[tuple[float, float], ...]
    """Of other traffic: y and speed along x [m/s]."""
    traffic_gap: float
    kerb_height: float
    parking: float
    """Share of the parking slots that is taken; 0 without parking."""
    parking_depths: tuple[float, float]
    """Of the slots left and right: cars stand along the road or, where it is deep, across it [m]."""
    cross_street_chance: float
    tree_gap: float
    pole_gap: float
    people_gap: float
    clutter_gap: float
    rail_chance: float
    median_rail: bool
    tree_size: float
    facade: buildings.FacadeStyle
    height: float
    """Typical of buildings [m]."""


def draw_style(kind: str, rng: np.random.Generator) -> Style:
    """A random style of one kind."""
    town = kind in ("urban", "residential", "mixed")
    lane = rng.uniform(2.7, 3.6) if town else rng.uniform(3.2, 3.8)
    same = int(rng.choice([0, 1], p=[0.75, 0.25])) if town else int(rng.integers(0, 3))
    inner = int(rng.choice([0, 1], p=[0.85, 0.15])) if town else int(rng.integers(0, 2))
    opposite = int(rng.choice(3, p=[0.25, 0.55, 0.2])) if town else int(rng.integers(1, 4))
    median = float(rng.uniform(0.5, 4.0)) if rng.uniform() < (0.1 if town else 0.6) else 0.0
    speed = rng.uniform(3.0, 15.0) if town else rng.uniform(12.0, 33.0)
    centre = lane * (0.5 + inner)
    speed *= rng.uniform() > 0.08
    lanes = [(-lane * (1 + k), speed * rng.uniform(0.7, 1.1)) for k in range(same)]
    lanes += [(lane * (1 + k), speed * rng.uniform(0.9, 1.3)) for k in range(inner)]
    lanes += [(centre + median + lane * (0.5 + k), -speed * rng.uniform(0.8, 1.2)) for k in range(opposite)]
    shoulder = rng.uniform(0.3, 1.2) if town else rng.uniform(0.5, 3.5)
    parking = rng.uniform(0.2, 1.0) if town and rng.uniform() < 0.65 else 0.0
    depths = rng.choice([0.0, 2.2, 5.0], size=2, p=[0.15, 0.7, 0.15]) * (parking > 0)
    left_edge = centre + median + lane * opposite + shoulder + depths[0]
    right_edge = -(lane * (0.5 + same) + shoulder + depths[1])
    walks = rng.uniform(0.8, 5.0, 2) + rng.uniform(0.0, 3.0) * (rng.uniform() < 0.5)
    odds = np.array(ODDS[kind]) * np.exp(rng.normal(0.0, 0.7, len(FRONTS)))
    return Style(
        kind=kind,
        odds=tuple(odds / odds.sum()),
        left_edge=max(left_edge, 2.6),
        right_edge=min(right_edge, -2.3),
        left_front=max(left_edge, 2.6) + walks[0],
        right_front=min(right_edge, -2.3) - walks[1],
        lanes=tuple(lanes),
        traffic_gap=float(np.exp(rng.uniform(np.log(15.0), np.log(200.0)))),
        kerb_height=rng.uniform(0.08, 0.18) if town and rng.uniform() < 0.85 else 0.0,
        parking=parking,
        parking_depths=(float(depths[0]), float(depths[1])),
        cross_street_chance=rng.uniform(0.1, 0.8) if town else rng.uniform(0.0, 0.2),
        tree_gap=float(np.exp(rng.uniform(np.log(6.0), np.log(60.0)))),
        pole_gap=float(np.exp(rng.uniform(np.log(12.0), np.log(60.0)))),
        people_gap=float(np.exp(rng.uniform(np.log(8.0), np.log(150.0)))) if town else 1e6,
        clutter_gap=float(np.exp(rng.uniform(np.log(5.0), np.log(80.0)))) * (1.0 if town else 3.0),
        rail_chance=rng.uniform(0.2, 1.0) if not town else rng.uniform(0.0, 0.15),
        median_rail=median > 1.0 and opposite > 0 and rng.uniform() < 0.8,
        tree_size=rng.uniform(0.5, 1.4),
        facade=buildings.draw_facade_style(rng),
        height=rng.uniform(5.0, 20.0),
    )


def lay_chunk(b: Builder, style: Style, x0: float, x1: float) -> None:
    """Dress the road from x0 to x1."""
    rng = b.rng
    cross = None
    if rng.uniform() < style.cross_street_chance:
        middle, half = rng.uniform(x0 + 10.0, x1 - 10.0), rng.uniform(3.0, 8.0)
        cross = (middle - half, middle + half)
    if style.median_rail:
        left_lanes = [y for y, speed in style.lanes if speed < 0.0]
        own = [0.0] + [y for y, speed in style.lanes if speed > 0.0]
        objects.guard_rail(b, x0, x1, 0.5 * (min(left_lanes) + max(own)))
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
                _front(b, style, side, start, stop)
                start = stop
        if len(stretches) == 2:
            _cross_street(b, style, side, *cross)


def _places(rng: np.random.Generator, x0: float, x1: float, gap: float) -> np.ndarray:
    """Random positions, `gap` apart on average."""
    return np.sort(rng.uniform(x0, x1, rng.poisson((x1 - x0) / gap)))


def lay_traffic(b: Builder, style: Style, lane: tuple[float, float], x0: float, x1: float) -> None:
    """The vehicles of one lane that are between x0 and x1 at time 0, all equally fast."""
    y, speed = lane
    x = x0 + 8.0 + b.rng.exponential(style.traffic_gap)
    while x < x1 - 8.0:
        objects.car(b, x, y + b.rng.normal(0.0, 0.15), 0.0 if speed >= 0.0 else np.pi, abs(speed))
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
                objects.car(b, x, side * (edge - 0.5 * depth + 0.05 + rng.normal(0.0, 0.08)), yaw)
            x += step * rng.uniform(1.0, 1.4)
    if style.kerb_height:
        objects.slab(b, x0, x1, *sorted((side * edge, side * (front + 0.1))), style.kerb_height)
    inside = max(edge + 0.3, front - 0.4)
    if rng.uniform() < style.rail_chance:
        objects.guard_rail(b, x0, x1, side * (edge + rng.uniform(0.0, 0.5)))
    row, tree_row = edge + rng.uniform(0.3, 0.8), edge + rng.uniform(0.6, 1.5)
    for x in np.arange(x0 + rng.uniform(0.0, style.pole_gap), x1, style.pole_gap):
        objects.pole(b, x, side * row, -side)
    for x in np.arange(x0 + rng.uniform(0.0, style.tree_gap), x1, style.tree_gap):
        objects.tree(b, x + rng.normal(0.0, 0.5), side * tree_row, style.tree_size * rng.uniform(0.5, 1.1))
    for x in _places(rng, x0, x1, style.people_gap):
        objects.pedestrian(b, x, side * rng.uniform(edge + 0.2, inside), rng.uniform(0.3, 1.8) * (rng.uniform() < 0.8))
    for x in _places(rng, x0, x1, style.clutter_gap):
        objects.clutter(b, x, side * rng.uniform(edge + 0.3, inside))


def _front(b: Builder, style: Style, side: float, x0: float, x1: float) -> None:
    """Line one stretch of one side."""
    rng = b.rng
    y = style.left_front if side > 0 else -style.right_front
    front = FRONTS[rng.choice(len(FRONTS), p=style.odds)]
    if front == "facades":
        _facades(b, style, side, x0, x1, y)
    elif front == "houses":
        _houses(b, style, side, x0, x1, y)
    elif front == "parking":
        for row in range(int(rng.integers(1, 4))):
            for x in np.arange(x0 + 2.0, x1 - 1.5, rng.uniform(2.5, 2.9)):
                if rng.uniform() < 0.6:
                    objects.car(b, x, side * (y + 3.0 + 6.5 * row), 0.5 * np.pi + rng.normal(0.0, 0.04))
        _background(b, style, side, x0, x1, y + 24.0)
    elif front == "noise_wall":
        objects.wall(b, x0, x1, side * (y + rng.uniform(0.5, 6.0)), rng.uniform(2.0, 5.0))
        _background(b, style, side, x0, x1, y + 10.0)
    elif front == "treeline":
        _treeline(b, style, side, x0, x1, y + rng.uniform(0.5, 12.0))
    else:
        _boundary(b, front, side, x0, x1, y)
        spread, gap = rng.uniform(6.0, 35.0), rng.uniform(2.0, 12.0) * (3.0 if front == "field" else 1.0)
        size = rng.uniform(0.3, 1.6)
        for x in _places(rng, x0, x1, gap):
            objects.bush(b, x, side * (y + 0.8 + spread * rng.uniform() ** 2), size * rng.uniform(0.5, 1.5))
        for x in _places(rng, x0, x1, 3.0 * gap):
            objects.tree(b, x, side * (y + rng.uniform(2.0, 2.0 + spread)), style.tree_size * rng.uniform(0.4, 1.4))
        _background(b, style, side, x0, x1, y + spread)


def _boundary(b: Builder, front: str, side: float, x0: float, x1: float, y: float) -> None:
    """The border of a property, with a gap for a drive."""
    rng = b.rng
    if front in ("park", "field", "bushes") and rng.uniform() < 0.7:
        return
    gate = rng.uniform(x0, x1)
    for start, end in ((x0, gate), (gate + rng.uniform(1.0, 5.0), x1)):
        if end - start < 1.5:
            continue
        choice = front if front in ("wall", "hedge", "fence") else str(rng.choice(["wall", "hedge", "fence"]))
        if choice == "wall":
            objects.wall(b, start, end, side * (y + 0.2), rng.uniform(0.4, 2.5))
        elif choice == "hedge":
            objects.hedge(b, start, end, side * (y + 0.6))
        else:
            objects.fence(b, start, end, side * (y + 0.1))


def _facades(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """Buildings side by side, with gaps."""
    rng = b.rng
    x, setback = x0, rng.uniform(0.0, 4.0) * (rng.uniform() < 0.4)
    while x < x1 - 4.0:
        width = min(rng.uniform(6.0, 30.0), x1 - x)
        out = setback + rng.uniform(0.0, 1.0) * (rng.uniform() < 0.5)
        height = style.height * rng.uniform(0.5, 1.4)
        buildings.building(
            b,
            x + 0.5 * width,
            side * (y + 0.4 + out),
            np.pi if side > 0 else 0.0,
            width=width,
            depth=rng.uniform(8.0, 18.0),
            height=height,
            style=style.facade,
        )
        x += width + rng.uniform(1.0, 12.0) * (rng.uniform() < 0.3)
    if rng.uniform() < 0.3:
        _boundary(b, "any", side, x0, x1, y)
    _background(b, style, side, x0, x1, y + 20.0)


def _houses(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """Detached houses in gardens."""
    rng = b.rng
    x = x0 + rng.uniform(5.0, 9.0)
    while x < x1 - 4.0:
        setback = rng.uniform(2.5, 14.0)
        turn = rng.normal(0.0, 0.05) + float(rng.choice([0.0, 0.5 * np.pi], p=[0.85, 0.15]))
        if turn > 1.0:
            setback += 7.0
        buildings.house(b, x, side * (y + setback), (np.pi if side > 0 else 0.0) + turn, style.facade)
        if rng.uniform() < 0.4:
            objects.car(b, x + rng.uniform(5.0, 8.0), side * (y + rng.uniform(3.0, 6.0)), 0.5 * np.pi)
        for _ in range(rng.poisson(3.0)):
            where = x + rng.uniform(-8.0, 8.0), side * (y + rng.uniform(0.8, setback + 0.8))
            plant = objects.tree if rng.uniform() < 0.4 else objects.bush
            plant(b, *where, rng.uniform(0.3, 1.0))
        x += rng.uniform(11.0, 26.0)
    if rng.uniform() < 0.8:
        _boundary(b, "any", side, x0, x1, y)
    _background(b, style, side, x0, x1, y + 25.0)


def _treeline(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """A wood's edge: rows of trees with undergrowth."""
    rng = b.rng
    gap, size = rng.uniform(1.8, 7.0), style.tree_size * rng.uniform(0.5, 1.3)
    for row in range(int(rng.integers(1, 4))):
        for x in np.arange(x0 + rng.uniform(0.0, gap), x1, gap):
            where = x + rng.normal(0.0, 0.6), side * (y + 3.5 * row + abs(rng.normal(0.0, 0.8)))
            objects.tree(b, *where, size * rng.uniform(0.6, 1.3), 8 - 2 * row)
    for x in _places(rng, x0, x1, rng.uniform(1.5, 12.0)):
        objects.bush(b, x, side * (y + rng.uniform(0.0, 8.0)), rng.uniform(0.3, 1.3))


def _background(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """What is seen through the gaps: a second row of buildings or trees."""
    rng = b.rng
    if rng.uniform() < 0.5:
        for x in _places(rng, x0, x1, 15.0):
            objects.tree(b, x, side * (y + rng.uniform(3.0, 40.0)), rng.uniform(0.7, 1.6), 5)
    if style.kind in ("urban", "residential", "mixed") and rng.uniform() < 0.6:
        x, width = rng.uniform(x0, x1), rng.uniform(8.0, 25.0)
        buildings.building(
            b,
            x,
            side * (y + rng.uniform(8.0, 30.0)),
            (np.pi if side > 0 else 0.0) + rng.normal(0.0, 0.1),
            width=width,
            depth=10.0,
            height=style.height,
            style=style.facade,
        )


def _cross_street(b: Builder, style: Style, side: float, x0: float, x1: float) -> None:
    """A side street: waiting and parked cars, buildings and trees along it."""
    rng = b.rng
    y = style.left_front if side > 0 else -style.right_front
    for x, facing in ((x0, 1.0), (x1, -1.0)):
        for distance in np.arange(y + rng.uniform(22.0, 30.0), 75.0, rng.uniform(16.0, 30.0)):
            if style.kind in ("urban", "residential", "mixed") and rng.uniform() < 0.7:
                buildings.building(
                    b,
                    x - facing * rng.uniform(1.0, 5.0),
                    side * distance,
                    -facing * 0.5 * np.pi,
                    width=rng.uniform(8.0, 15.0),
                    depth=10.0,
                    height=style.height,
                    style=style.facade,
                )
            else:
                objects.tree(b, x - facing * rng.uniform(1.0, 4.0), side * distance, style.tree_size)
        for distance in _places(rng, y + 3.0, 60.0, 15.0):
            objects.car(b, x + facing * 1.2, side * distance, 0.5 * np.pi)
    if rng.uniform() < 0.4:
        objects.car(b, 0.5 * (x0 + x1), side * (y + 3.0), side * 0.5 * np.pi, rng.uniform(0.0, 4.0))
