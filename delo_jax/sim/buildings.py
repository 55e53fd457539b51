"""Buildings: boxes with relief where a scanner on a car looks."""

from typing import NamedTuple

import numpy as np

from delo_jax.sim.primitives import Builder, Label


class FacadeStyle(NamedTuple):
    """What the fronts of a street have in common."""

    pier_chance: float
    bay_chance: float
    balcony_chance: float
    awning_chance: float
    setback_m: float
    """Largest difference of depth between the parts of one front."""
    window_m: float
    """Distance of the windows."""


def draw_facade_style(rng: np.random.Generator) -> FacadeStyle:
    """A random style."""
    return FacadeStyle(
        pier_chance=rng.uniform(0.0, 0.9),
        bay_chance=rng.uniform(0.0, 0.7),
        balcony_chance=rng.uniform(0.0, 0.6),
        awning_chance=rng.uniform(0.0, 0.5),
        setback_m=rng.uniform(0.0, 2.0),
        window_m=rng.uniform(1.4, 4.0),
    )


def building(b: Builder, x: float, y: float, yaw: float, *, width: float, depth: float, height: float, style: FacadeStyle) -> None:
    """A building; (x, y) is the middle of its front, which looks along its own +y.

    The front consists of parts at different depths, with piers between recessed windows, bays,
    balconies, awnings, a plinth, steps and drain pipes.
    """
    rng = b.rng
    b.begin(Label.BUILDING, x, y, yaw + rng.normal(0.0, 0.01))
    cuts = np.sort(rng.uniform(-0.4, 0.4, int(rng.integers(0, 3)))) * width
    edges = [-0.5 * width, *cuts, 0.5 * width]
    for left, right in zip(edges[:-1], edges[1:], strict=True):
        front = -float(rng.uniform(0.0, style.setback_m)) if len(edges) > 2 else 0.0
        _front_part(b, float(left), float(right), front, depth, height * rng.uniform(0.9, 1.0), style)


def _front_part(b: Builder, left: float, right: float, front: float, depth: float, height: float, style: FacadeStyle) -> None:
    rng = b.rng
    b.box((left, right), (-depth, front), (0.0, height))
    if right - left < 1.5:
        return
    if rng.uniform() < 0.4:
        b.box((left, right), (front - 0.1, front + rng.uniform(0.04, 0.25)), (0.0, rng.uniform(0.3, 1.2)))
    if rng.uniform() < style.pier_chance:
        _piers(b, left, right, front, height, style.window_m)
    floors = range(1, max(2, int(height / 3.0)))
    if rng.uniform() < style.bay_chance:
        middle, half = rng.uniform(left + 0.7, right - 0.7), rng.uniform(0.6, min(2.5, 0.5 * (right - left)))
        bottom = float(rng.choice([0.0, 2.8]))
        b.box((middle - half, middle + half), (front, front + rng.uniform(0.3, 1.5)), (bottom, height))
    if rng.uniform() < style.balcony_chance:
        middle, half, out = rng.uniform(left + 0.7, right - 0.7), rng.uniform(0.7, 2.5), rng.uniform(0.6, 1.6)
        for floor in floors:
            b.box((middle - half, middle + half), (front, front + out), (3.0 * floor - 0.1, 3.0 * floor + 0.1))
            b.box(
                (middle - half, middle + half),
                (front + out - 0.05, front + out),
                (3.0 * floor, 3.0 * floor + 1.0),
                opacity=0.5,
            )
    if rng.uniform() < style.awning_chance:
        b.box((left + 0.3, right - 0.3), (front, front + rng.uniform(0.5, 2.0)), (2.4, rng.uniform(2.45, 3.1)))
    if rng.uniform() < 0.5:
        door = rng.uniform(left, right)
        for step in range(1, int(rng.integers(2, 5))):
            b.box((door - 0.8, door + 0.8), (front, front + 0.3 * step), (0.0, 0.5 - 0.12 * step + 0.05))
    if rng.uniform() < 0.5:
        b.post(left + 0.15, front + 0.1, 0.06, (0.0, height))


def _piers(b: Builder, left: float, right: float, front: float, height: float, window_m: float) -> None:
    """Wall strips that stand out between the windows, and bands between the floors."""
    rng = b.rng
    out, half = rng.uniform(0.08, 0.35), window_m * rng.uniform(0.12, 0.35)
    for x in np.arange(left + half, right - half, window_m):
        b.box((x - half, x + half), (front, front + out), (0.0, height))
    sill, lintel = rng.uniform(0.5, 1.1), rng.uniform(2.1, 2.6)
    b.box((left, right), (front, front + out * 0.98), (0.0, sill))
    b.box((left, right), (front, front + out * 0.98), (lintel, 3.0 + sill))


def house(b: Builder, x: float, y: float, yaw: float, style: FacadeStyle) -> None:
    """A detached house with a pitched roof and perhaps an extension, a porch or a garage."""
    rng = b.rng
    width, depth, height = rng.uniform(7.0, 15.0), rng.uniform(7.0, 13.0), rng.uniform(3.0, 7.0)
    building(b, x, y, yaw, width=width, depth=depth, height=height, style=style)
    steps, ridge = 3, rng.uniform(1.5, 4.0)
    for k in range(steps):
        inset = 0.5 * depth * (k + 0.3) / steps
        z = height + ridge * k / steps
        b.box((-0.5 * width, 0.5 * width), (-depth + inset, -inset), (z, z + ridge / steps))
    side = float(rng.choice([-1.0, 1.0]))
    if rng.uniform() < 0.5:
        start, end = sorted((side * 0.5 * width, side * (0.5 * width + rng.uniform(2.5, 5.0))))
        setback = rng.uniform(-3.0, 5.0)
        b.box((start, end), (-setback - 6.0, -setback), (0.0, rng.uniform(2.3, 3.2)))
    if rng.uniform() < 0.5:
        porch, out = rng.uniform(-0.3, 0.3) * width, rng.uniform(0.8, 2.5)
        b.box((porch - 1.3, porch + 1.3), (0.0, out), (2.3, 2.6))
        for post in (-1.2, 1.2):
            b.post(porch + post, out - 0.1, 0.08, (0.0, 2.3))
