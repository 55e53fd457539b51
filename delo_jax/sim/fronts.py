"""What lines a road beyond the sidewalk: buildings, gardens, fields, woods, side streets."""

import numpy as np

from delo_jax.sim import buildings, objects
from delo_jax.sim.primitives import Builder
from delo_jax.sim.style import FRONTS, Style


def places(rng: np.random.Generator, x0: float, x1: float, gap: float) -> np.ndarray:
    """Random positions, `gap` apart on average."""
    return np.sort(rng.uniform(x0, x1, rng.poisson((x1 - x0) / gap)))


def lay_front(b: Builder, style: Style, side: float, x0: float, x1: float) -> None:
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
        spread, gap = rng.uniform(6.0, 35.0), np.exp(rng.uniform(0.0, 2.5)) * (3.0 if front == "field" else 1.0)
        size = rng.uniform(0.3, 1.6)
        if front == "bushes" and rng.uniform() < 0.6:
            _thicket(b, side, x0, x1, y + size, size)
        for x in places(rng, x0, x1, gap):
            objects.bush(b, x, side * (y + 0.5 + size + spread * rng.uniform() ** 2), size * rng.uniform(0.5, 1.5))
        for x in places(rng, x0, x1, 3.0 * gap):
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


def _thicket(b: Builder, side: float, x0: float, x1: float, y: float, size: float) -> None:
    """A dense strip of bushes along the road."""
    rng = b.rng
    gap, depth = size * rng.uniform(0.8, 2.0), rng.uniform(0.2, 2.5)
    for x in np.arange(x0, x1, gap):
        objects.bush(b, x + rng.normal(0.0, 0.3), side * (y + abs(rng.normal(0.0, depth))), size * rng.uniform(0.5, 1.4))


def _treeline(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """A wood's edge: rows of trees with undergrowth."""
    rng = b.rng
    gap, size = rng.uniform(1.8, 7.0), style.tree_size * rng.uniform(0.5, 1.3)
    for row in range(int(rng.integers(1, 4))):
        for x in np.arange(x0 + rng.uniform(0.0, gap), x1, gap):
            where = x + rng.normal(0.0, 0.6), side * (y + 3.5 * row + abs(rng.normal(0.0, 0.8)))
            objects.tree(b, *where, size * rng.uniform(0.6, 1.3), clumps=8 - 2 * row)
    for x in places(rng, x0, x1, rng.uniform(1.5, 12.0)):
        objects.bush(b, x, side * (y + rng.uniform(0.0, 8.0)), rng.uniform(0.3, 1.3))


def _background(b: Builder, style: Style, side: float, x0: float, x1: float, y: float) -> None:
    """What is seen through the gaps: a second row of buildings or trees."""
    rng = b.rng
    if rng.uniform() < 0.5:
        for x in places(rng, x0, x1, 15.0):
            objects.tree(b, x, side * (y + rng.uniform(3.0, 40.0)), rng.uniform(0.7, 1.6), clumps=5)
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


def lay_cross_street(b: Builder, style: Style, side: float, x0: float, x1: float) -> None:
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
        for distance in places(rng, y + 3.0, 60.0, 15.0):
            objects.car(b, x + facing * 1.2, side * distance, 0.5 * np.pi)
    if rng.uniform() < 0.4:
        objects.car(b, 0.5 * (x0 + x1), side * (y + 3.0), side * 0.5 * np.pi, rng.uniform(0.0, 4.0))
