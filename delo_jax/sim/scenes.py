"""Random worlds along a road: what stands where, drawn broadly so that scenes differ in structure.

The flat world: the road runs along +x, the vehicle drives near y = 0, z = 0 is the road surface.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from delo_jax.errors import ConfigError
from delo_jax.sim import objects, roadside
from delo_jax.sim.motion import Motion
from delo_jax.sim.primitives import Builder, Primitives, concatenate, take
from delo_jax.sim.style import Style, draw_style
from delo_jax.sim.warp import Warp, draw_warp

KINDS = ("urban", "residential", "mixed", "road", "open")
MARGIN_M = 100.0
"""The scene reaches this far before its start and beyond its end."""
CLEARANCE_M = 1.5
"""Of what stands or moves near the vehicle's path."""
LANE_HALF_M = 2.0
"""No object stands nearer to the middle of the vehicle's lane."""


class Ground(NamedTuple):
    """The plane z = 0: a smooth road between rough verges."""

    left: float
    """Rough where y is greater [m]."""
    right: float
    """Rough where y is less [m]."""
    grass_height: float
    """Mean height of what grows there [m]."""
    road_reflectance: float
    grass_reflectance: float


class Scene(NamedTuple):
    """A world at time 0."""

    primitives: Primitives
    ground: Ground
    warp: Warp


def make_scene(kind: str, seed: int, length_m: float = 120.0, *, traffic: float = 1.0) -> Scene:
    """A random scene of one kind, a function of its arguments alone.

    Args:
        kind: one of `KINDS`.
        seed: of everything drawn.
        length_m: of the drivable road; it is dressed for 100 m more at both ends.
        traffic: density of the vehicles in the lanes, as a factor > 0.
    """
    style, ground, warp = draw_world(kind, seed)
    style = style._replace(traffic_gap=style.traffic_gap / traffic)
    first = int(np.floor(-MARGIN_M / roadside.CHUNK_M))
    last = int(np.ceil((length_m + MARGIN_M) / roadside.CHUNK_M))
    chunks = [make_chunk(style, seed, index) for index in range(first, last)]
    chunks += [make_traffic(style, seed, lane, i) for lane in range(len(style.lanes)) for i in range(first, last)]
    return Scene(concatenate(chunks), ground, warp)


def draw_world(kind: str, seed: int) -> tuple[Style, Ground, Warp]:
    """What all parts of a drive share: the road's style, its surface and its course.

    Raises:
        ConfigError: unknown kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    style = draw_style(kind, rng)
    country = kind in ("road", "open")
    rough = country or rng.uniform() < 0.4
    ground = Ground(
        left=style.left_edge + rng.uniform(0.0, 1.5) if rough else style.left_front + rng.uniform(0.0, 2.0),
        right=style.right_edge - rng.uniform(0.0, 1.5) if rough else style.right_front - rng.uniform(0.0, 2.0),
        grass_height=float(rng.uniform(0.01, 0.15) if country else rng.uniform(0.005, 0.06)),
        road_reflectance=float(np.exp(rng.uniform(np.log(0.05), np.log(0.3)))),
        grass_reflectance=float(rng.uniform(0.2, 0.5)),
    )
    warp = draw_warp(
        rng,
        max_slope=float(rng.choice([0.02, 0.05, 0.09])),
        max_bend=float(rng.uniform(0.0, 0.35)),
        banks=kind == "open" or (kind in ("road", "mixed") and rng.uniform() < 0.5),
        verge=(ground.left, -ground.right),
    )
    return style, ground, warp


def make_chunk(style: Style, seed: int, index: int) -> Primitives:
    """What stands or walks from `index * CHUNK_M` on, clear of the vehicle's lane; its object ids are its own."""
    rng = np.random.default_rng([seed, 7, index + 1_000_000])
    builder = Builder(rng, first_id=1 + 4096 * (index + 1024))
    start = index * roadside.CHUNK_M
    roadside.lay_chunk(builder, style, start, start + roadside.CHUNK_M)
    primitives = builder.build()
    sin, cos = np.sin(primitives.yaw), np.cos(primitives.yaw)
    reach = np.abs(sin) * primitives.half_size[:, 0] + np.abs(cos) * primitives.half_size[:, 1]
    return without(primitives, at_body_height(primitives) & (np.abs(primitives.center[:, 1]) - reach < LANE_HALF_M))


def at_body_height(primitives: Primitives) -> Bool[np.ndarray, " n"]:
    """Whether a shape is in a vehicle's way: neither a kerb nor high above the road."""
    z, half_z = primitives.center[:, 2], primitives.half_size[:, 2]
    return (z + half_z > 0.3) & (z - half_z < 2.8)


def without(primitives: Primitives, unwanted: Bool[np.ndarray, " n"]) -> Primitives:
    """The primitives without the objects that have an unwanted shape."""
    return take(primitives, ~np.isin(primitives.object_id, primitives.object_id[unwanted]))


def make_traffic(style: Style, seed: int, lane: int, index: int) -> Primitives:
    """The vehicles of one lane that are at time 0 within `CHUNK_M` from `index * CHUNK_M` on."""
    rng = np.random.default_rng([seed, 11, lane, index + 1_000_000])
    builder = Builder(rng, first_id=1_000_000_000 + 64 * ((index + 100_000) * 16 + lane))
    start = index * roadside.CHUNK_M
    roadside.lay_traffic(builder, style, style.lanes[lane], start, start + roadside.CHUNK_M)
    return builder.build()


def clear_path(scene: Scene, motion: Motion) -> Scene:
    """The scene without the objects that the vehicle would come closer to than `CLEARANCE_M`.

    Kerbs and what hangs high above the road stay.
    """
    return scene._replace(primitives=without(scene.primitives, _blocking(scene.primitives, motion)))


def _blocking(primitives: Primitives, motion: Motion) -> Bool[np.ndarray, " n"]:
    """Which shapes are in the way."""
    cos, sin = np.cos(primitives.yaw), np.sin(primitives.yaw)
    near = np.zeros(len(cos), dtype=bool)
    for i in range(0, len(motion.heading), 5):
        moved = primitives.center[:, :2] + motion.times[i] * primitives.velocity
        dx, dy = (motion.position[i] - moved).T
        outside = np.abs(np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=1)) - primitives.half_size[:, :2]
        near |= np.linalg.norm(np.maximum(outside, 0.0), axis=1) < CLEARANCE_M
    return near & at_body_height(primitives)


def match_traffic(scene: Scene, motion: Motion, seed: int) -> Scene:
    """The scene with one or two vehicles ahead of or behind the vehicle in its lane, about as fast."""
    rng = np.random.default_rng([seed, 23])
    step = motion.position[-1] - motion.position[0]
    speed = float(np.linalg.norm(step)) / max(motion.times[-1] - motion.times[0], 1e-3)
    heading = float(np.arctan2(step[1], step[0])) if speed > 0.3 else float(motion.heading[0])
    builder = Builder(rng, first_id=1)
    for direction in (1.0, -1.0):
        if rng.uniform() < 0.35:
            gap = direction * (rng.uniform(9.0, 14.0) + speed * rng.uniform(0.0, 1.5))
            x, y = motion.position[0] + gap * np.array([np.cos(heading), np.sin(heading)])
            objects.car(builder, float(x), float(y), heading, max(0.0, speed + rng.normal(0.0, 1.0)), lorries=True)
    return scene._replace(primitives=concatenate([scene.primitives, builder.build()]))


def lead_vehicle(rng: np.random.Generator) -> Primitives:
    """A standing vehicle at the origin, heading along x, with an id that no other object has."""
    builder = Builder(rng, first_id=2_000_000_000)
    objects.car(builder, 0.0, 0.0, 0.0, lorries=True)
    return builder.build()
