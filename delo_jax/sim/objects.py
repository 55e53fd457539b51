"""Things that stand or move along a road, each in its own frame and of random size."""

import numpy as np

from delo_jax.sim.primitives import Builder, Label, Shape

PIECE_M = 12.0
"""Long things are built of pieces of this length, so that rays are tested against few of them."""


def car(b: Builder, x: float, y: float, yaw: float, speed: float = 0.0, *, lorries: bool = False) -> None:
    """A passenger car, a van or, rarely and where allowed, a lorry, heading along `yaw`."""
    rng = b.rng
    velocity = (speed * float(np.cos(yaw)), speed * float(np.sin(yaw)))
    reflectance = float(rng.choice([0.005, 0.03, 0.2, 0.5]))
    b.begin(Label.VEHICLE, x, y, yaw, reflectance=reflectance, velocity=velocity)
    kind = rng.uniform()
    if kind < 0.85:
        _passenger_car(b)
    elif kind < 0.95 or not lorries:
        length, width, height = rng.uniform(2.2, 3.1), rng.uniform(0.9, 1.0), rng.uniform(1.8, 2.7)
        b.box((-length, length - 0.9), (-width, width), (0.35, height))
        b.box((length - 0.9, length), (-width, width), (0.35, rng.uniform(1.0, 1.4)))
    else:
        lorry(b)


def _passenger_car(b: Builder) -> None:
    """Body with round nose and tail, a cabin of glass, a roof, wheels."""
    rng = b.rng
    length, width = rng.uniform(1.75, 2.45), rng.uniform(0.8, 0.95)
    floor, belt, roof = rng.uniform(0.2, 0.35), rng.uniform(0.75, 1.05), rng.uniform(1.38, 1.85)
    nose, tail = rng.uniform(0.2, 0.7), rng.uniform(0.1, 0.5)
    b.box((-length + tail, length - nose), (-width, width), (floor, belt))
    hood = 0.5 * (belt - floor)
    b.add(Shape.CYLINDER, (length - nose, 0.0, floor + 0.9 * hood), (nose, width, 0.9 * hood))
    b.add(Shape.CYLINDER, (tail - length, 0.0, floor + hood), (tail, width, hood))
    back, front = -length * rng.uniform(0.65, 0.98), length * rng.uniform(0.1, 0.35)
    middle, half = 0.5 * (back + front), 0.5 * (front - back)
    glass = {"opacity": rng.uniform(0.4, 1.0), "dim": rng.choice([0.01, 1.0])}
    shape = Shape.ELLIPSOID if rng.uniform() < 0.5 else Shape.BOX
    tall = (roof - belt) * (1.0 if shape == Shape.ELLIPSOID else 0.5)
    b.add(shape, (middle, 0.0, roof - tall), (1.1 * half, width - 0.1, tall), **glass)
    b.box((middle - 0.7 * half, middle + 0.6 * half), (-width + 0.2, width - 0.2), (roof - 0.1, roof))
    for wheel in (-0.62, 0.62):
        b.box((wheel * length - 0.3, wheel * length + 0.3), (-width + 0.02, width - 0.02), (0.0, 0.4), dim=0.3)


def lorry(b: Builder) -> None:
    """Shapes of a lorry or a bus for the current object."""
    rng = b.rng
    length, height, floor = rng.uniform(3.0, 7.0), rng.uniform(2.8, 4.0), rng.uniform(0.4, 1.1)
    b.box((-length, length - 2.2), (-1.25, 1.25), (floor, height))
    b.box((length - 1.9, length), (-1.2, 1.2), (0.5, rng.uniform(2.4, 3.2)))
    for wheel in (-0.7 * length, -0.45 * length, length - 1.2):
        b.box((wheel - 0.5, wheel + 0.5), (-1.2, 1.2), (0.0, 1.0), dim=0.3)


def pedestrian(b: Builder, x: float, y: float, speed: float) -> None:
    """A person walking along the road, either way."""
    rng = b.rng
    velocity = (speed * float(rng.choice([-1.0, 1.0])), float(rng.normal(0.0, 0.03)) * (speed > 0.0))
    b.begin(Label.PEDESTRIAN, x, y, rng.uniform(-3.0, 3.0), velocity=velocity)
    height = rng.uniform(1.1, 1.9)
    b.add(Shape.ELLIPSOID, (0.0, 0.0, 0.68 * height), (0.22, 0.28, 0.33 * height))
    for foot in (-0.12, 0.12):
        b.post(foot * rng.uniform(0.5, 2.0), foot, 0.09, (0.0, 0.5 * height))


def pole(b: Builder, x: float, y: float, towards_road: float) -> None:
    """A lamp post, a sign, a traffic light or a bare pole; `towards_road` is +1 or -1 along y."""
    rng = b.rng
    b.begin(Label.POLE, x, y, 0.0 if towards_road > 0 else np.pi)
    kind, height = rng.uniform(), rng.uniform(3.5, 10.0)
    radius = rng.uniform(0.04, 0.16)
    if kind < 0.4:
        b.post(0.0, 0.0, radius, (0.0, height))
        b.box((-0.1, 0.1), (0.0, rng.uniform(0.5, 2.5)), (height - 0.15, height))
    elif kind < 0.75:
        height = rng.uniform(1.8, 3.5)
        b.post(0.0, 0.0, 0.04, (0.0, height))
        size = rng.uniform(0.2, 0.6)
        b.box((-0.03, 0.03), (-size, size), (height - rng.uniform(0.3, 1.0), height), dim=2.0)
    elif kind < 0.85:
        b.post(0.0, 0.0, 0.07, (0.0, 3.4))
        b.box((-0.15, 0.15), (-0.15, 0.2), (2.4, 3.4))
    else:
        b.post(0.0, 0.0, 1.5 * radius, (0.0, height))
        b.post(0.0, 0.0, 2.5 * radius, (0.0, rng.uniform(0.3, 1.2)))


def tree(b: Builder, x: float, y: float, size: float, *, clumps: int = 9, clear_m: float = 0.0) -> None:
    """A broad-leaved tree or a conifer; `size` of about 1 is a grown street tree, cut free up to `clear_m`."""
    rng = b.rng
    b.begin(Label.VEGETATION, x, y, rng.uniform(-3.0, 3.0), reflectance=0.4)
    height, radius = size * rng.uniform(5.0, 11.0), size * rng.uniform(1.2, 3.2)
    openness = rng.uniform(0.3, 1.2)
    b.post(0.0, 0.0, size * rng.uniform(0.08, 0.3), (0.0, 0.7 * height))
    if rng.uniform() < 0.2 and clear_m == 0.0:
        skirt = rng.uniform(0.0, 0.15)
        for k in range(4):
            level = skirt + (0.95 - skirt) * (k + 0.3) / 4.0
            b.crown(0.0, 0.0, level * height, radius * (1.05 - level), 0.16 * height, 0.4 * openness * radius)
        return
    bottom = rng.uniform(0.1, 0.5) * height
    for _ in range(int(rng.integers(2, clumps + 1))):
        angle, offset = rng.uniform(-np.pi, np.pi), radius * rng.uniform(0.0, 0.9)
        part = radius * rng.uniform(0.2, 0.65)
        flat = rng.uniform(0.5, 1.1)
        z = max(rng.uniform(bottom, height), bottom + 0.5 * part, clear_m + part * flat)
        b.crown(offset * np.cos(angle), offset * np.sin(angle), z, part, part * flat, part * openness)


def bush(b: Builder, x: float, y: float, size: float) -> None:
    """Low foliage down to the ground, of several clumps."""
    rng = b.rng
    b.begin(Label.VEGETATION, x, y, rng.uniform(-3.0, 3.0), reflectance=0.4)
    openness = rng.uniform(0.15, 1.0)
    for _ in range(int(rng.integers(2, 6))):
        radius = size * rng.uniform(0.2, 0.8)
        height = radius * rng.uniform(0.5, 1.5)
        dx, dy = rng.normal(0.0, 0.5 * size, 2)
        b.crown(dx, dy, height * rng.uniform(0.3, 1.0), radius, height, radius * openness)


def hedge(b: Builder, x0: float, x1: float, y: float) -> None:
    """A cut hedge along x, uneven from metre to metre."""
    rng = b.rng
    b.begin(Label.VEGETATION, 0.0, y, reflectance=0.4)
    height, half, softness = rng.uniform(0.7, 2.4), rng.uniform(0.2, 0.6), rng.uniform(0.03, 0.2)
    for start, end in _pieces(x0, x1, rng.uniform(1.5, 6.0)):
        bulge = rng.normal(0.0, 0.06)
        top = height * rng.uniform(0.93, 1.05)
        b.box((start, end), (-half - bulge, half + bulge), (0.0, top), softness=softness)


def wall(b: Builder, x0: float, x1: float, y: float, height: float) -> None:
    """A wall along x, with pillars or without."""
    rng = b.rng
    b.begin(Label.WALL, 0.0, y)
    half, pillar = rng.uniform(0.08, 0.2), rng.uniform(0.0, 0.15) * (rng.uniform() < 0.6)
    for start, end in _pieces(x0, x1, rng.uniform(2.5, PIECE_M)):
        b.box((start, end), (-half, half), (0.0, height))
        if pillar > 0.03:
            b.box((start - 0.2, start + 0.2), (-half - pillar, half + pillar), (0.0, height + pillar))


def fence(b: Builder, x0: float, x1: float, y: float) -> None:
    """A part-transparent fence along x: mesh or pickets between posts, sometimes on a low wall."""
    rng = b.rng
    b.begin(Label.FENCE, 0.0, y)
    height, opacity = rng.uniform(0.8, 2.2), rng.uniform(0.15, 0.85)
    base = rng.uniform(0.2, 0.6) * (rng.uniform() < 0.3)
    step = rng.uniform(2.0, 4.0)
    for start, end in _pieces(x0, x1, step):
        b.box((start, end), (-0.015, 0.015), (base, height), opacity=opacity)
        b.post(start, 0.0, 0.04, (0.0, height))
    if base:
        for start, end in _pieces(x0, x1, PIECE_M):
            b.box((start, end), (-0.12, 0.12), (0.0, base))


def guard_rail(b: Builder, x0: float, x1: float, y: float) -> None:
    """A steel rail on posts along x, or a concrete barrier."""
    rng = b.rng
    b.begin(Label.RAIL, 0.0, y, reflectance=0.4)
    if rng.uniform() < 0.2:
        for start, end in _pieces(x0, x1, PIECE_M):
            b.box((start, end), (-0.3, 0.3), (0.0, 0.3))
            b.box((start, end), (-0.12, 0.12), (0.3, rng.uniform(0.8, 0.81)))
        return
    step = rng.uniform(2.0, 4.0)
    for start, end in _pieces(x0, x1, 2.0 * step):
        b.box((start, end), (-0.05, 0.05), (0.43, 0.75))
        b.box((start, end), (-0.09, 0.09), (0.50, 0.56))
        b.post(start, 0.12, 0.06, (0.0, 0.7))
        b.post(start + step, 0.12, 0.06, (0.0, 0.7))


def slab(b: Builder, x0: float, x1: float, y0: float, y1: float, height: float) -> None:
    """A kerbed sidewalk or island."""
    b.begin(Label.KERB, 0.0, 0.0, reflectance=0.25)
    for start, end in _pieces(x0, x1, PIECE_M):
        b.box((start, end), (y0, y1), (-0.5, height))


def clutter(b: Builder, x: float, y: float) -> None:
    """A bin, bench, planter, bollard, cabinet, parked bicycle, or a shelter."""
    rng = b.rng
    b.begin(Label.CLUTTER, x, y, rng.choice([0.0, 0.5 * np.pi]) + rng.normal(0.0, 0.2))
    kind = rng.uniform()
    if kind < 0.35:
        b.box((-rng.uniform(0.2, 0.8), 0.3), (-0.3, rng.uniform(0.2, 0.5)), (0.0, rng.uniform(0.4, 1.6)))
    elif kind < 0.55:
        b.post(0.0, 0.0, rng.uniform(0.06, 0.4), (0.0, rng.uniform(0.4, 1.2)))
    elif kind < 0.75:
        b.box((-0.85, 0.85), (-0.03, 0.03), (0.1, 1.0), opacity=0.4)
        b.box((-0.1, 0.3), (-0.2, 0.2), (0.8, 1.0), opacity=0.6)
    elif kind < 0.92:
        b.box((-0.9, 0.9), (-0.25, 0.25), (0.38, 0.48))
        b.box((-0.9, 0.9), (0.2, 0.27), (0.5, 0.9), opacity=0.7)
    else:
        half = rng.uniform(0.6, 1.6)
        b.box((-half, half), (0.4, 0.45), (0.1, 2.3), opacity=rng.uniform(0.3, 1.0))
        b.box((-half, half), (-0.6, 0.5), (2.3, 2.4))
        for post in (-half, half):
            b.box((post - 0.03, post + 0.03), (-0.3, 0.4), (0.0, 2.3), opacity=0.8)


def bridge(b: Builder, x: float, y0: float, y1: float) -> None:
    """A bridge across the road, between abutments at y0 and y1."""
    rng = b.rng
    b.begin(Label.WALL, x, 0.0)
    half, height = rng.uniform(2.0, 8.0), rng.uniform(4.6, 6.5)
    b.box((-half, half), (y0 - 6.0, y0), (0.0, height))
    b.box((-half, half), (y1, y1 + 6.0), (0.0, height))
    b.box((-half, half), (y0 - 6.0, y1 + 6.0), (height, height + 1.0))


def gantry(b: Builder, x: float, y0: float, y1: float) -> None:
    """A sign bridge across the road."""
    rng = b.rng
    b.begin(Label.POLE, x, 0.0)
    height = rng.uniform(5.2, 6.5)
    for y in (y0, y1):
        b.box((-0.2, 0.2), (y - 0.2, y + 0.2), (0.0, height))
    b.box((-0.3, 0.3), (y0, y1), (height, height + 0.6), opacity=0.7)
    b.box((-0.4, -0.3), (0.6 * y0, 0.6 * y1), (height - 0.5, height + 2.5))


def _pieces(x0: float, x1: float, length: float) -> list[tuple[float, float]]:
    """The interval cut into equal pieces of about this length."""
    edges = np.linspace(x0, x1, max(1, round((x1 - x0) / length)) + 1)
    return [(float(start), float(end)) for start, end in zip(edges[:-1], edges[1:], strict=True)]
