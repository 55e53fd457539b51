"""From beams to noisy points: everything about a scan that runs on the device, as one pure function."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt32

from delo_jax.sim import raycast
from delo_jax.sim.warp import Warp, evaluate


class Columns(NamedTuple):
    """What the device needs to know of each firing; positions from the local origin."""

    azimuth: Float[Array, " columns"]
    time: Float[Array, " columns"]
    origin: Float[Array, "3 columns"]
    R_flat_lidar: Float[Array, "3 3 columns"]
    """Maps beam directions into the flat world: J^-1 R_world_lidar, so that beams are straight and
    evenly spaced in the warped world near the sensor."""
    R_lidar_world: Float[Array, "3 3 columns"]
    warped_origin: Float[Array, "3 columns"]
    R_out: Float[Array, "3 3 columns"]
    """From the sensor frame at the firing to the frame of the delivered points."""
    t_out: Float[Array, "3 columns"]


class Beams(NamedTuple):
    """Calibration of the rings, in blocks."""

    elevation: Float[Array, "blocks rings"]
    azimuth_error: Float[Array, "blocks rings"]
    range_offset: Float[Array, "blocks rings"]
    blind: Float[Array, "4 3"]


class Ground(NamedTuple):
    """As `scenes.Ground`, counted from the local origin."""

    left: Float[Array, ""]
    right: Float[Array, ""]
    grass_height: Float[Array, ""]
    road_reflectance: Float[Array, ""]
    grass_reflectance: Float[Array, ""]


class Limits(NamedTuple):
    """Scalars of the sensor."""

    min_range: Float[Array, ""]
    max_range: Float[Array, ""]
    range_noise: Float[Array, ""]
    azimuth_jitter: Float[Array, ""]
    threshold: Float[Array, ""]
    dropout: Float[Array, ""]


class Measured(NamedTuple):
    """Everything about every ray, ring by ring."""

    points: Float[Array, "3 beams columns"]
    normals: Float[Array, "3 beams columns"]
    primitive: Int[Array, "beams columns"]
    keep: Bool[Array, "beams columns"]


def _rotate(matrices: Float[Array, "3 3 columns"], v: Float[Array, "3 blocks columns rings"]) -> Float[Array, "3 blocks columns rings"]:
    rotated = jnp.stack([sum(matrices[i, j][None, :, None] * v[j] for j in range(3)) for i in range(3)])
    # Else XLA computes the whole chain behind each component again for each of its uses.
    return jax.lax.optimization_barrier(rotated)


def measure(
    columns: Columns,
    beams: Beams,
    warp: Warp,
    table: raycast.Table,
    reflectance: Float[Array, " p"],
    ground: Ground,
    limits: Limits,
    work: raycast.Work,
    key: UInt32[Array, " 2"],
) -> Measured:
    """Cast all rays, warp the hits, lose and disturb some."""
    keys = jax.random.split(key, 5)
    shape = (beams.elevation.shape[0], len(columns.azimuth), beams.elevation.shape[1])
    jitter = limits.azimuth_jitter * jax.random.normal(keys[0], shape)
    azimuth = columns.azimuth[None, :, None] + beams.azimuth_error[:, None, :] + jitter
    elevation = jnp.broadcast_to(beams.elevation[:, None, :], shape)
    beam = jnp.stack([jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)])
    rays = raycast.Rays(
        origin=columns.origin,
        direction=_rotate(columns.R_flat_lidar, beam),
        time=columns.time,
        depth=-jnp.log1p(-jax.random.uniform(keys[1], shape)),
        luck=jax.random.uniform(keys[2], shape),
    )
    t, primitive = raycast.nearest_hit(rays, table, work)
    t_ground = _ground_hit(rays, ground)
    t, primitive = jnp.minimum(t, t_ground), jnp.where(t_ground < t, -1, primitive)
    hit = t < 1.2 * limits.max_range
    flat_point = rays.origin[:, None, :, None] + jnp.where(hit, t, 1.0)[None] * rays.direction
    flat_normal = _flat_normal(columns.time, table, primitive, flat_point)
    point, normal = _warp_hits(columns, warp, flat_point, flat_normal)

    distance = jnp.linalg.norm(point, axis=0)
    ray = point / jnp.maximum(distance, 1e-3)[None]
    cosine = -jnp.sum(ray * normal, axis=0)
    normal = jnp.where(cosine < 0.0, -1.0, 1.0)[None] * normal
    road = jnp.where(_is_rough(flat_point[1], ground), ground.grass_reflectance, ground.road_reflectance)
    signal = jnp.where(primitive < 0, road, reflectance[primitive]) * jnp.abs(cosine) / jnp.maximum(distance, 1.0) ** 2
    returned = signal**2 / (signal**2 + limits.threshold**2 + 1e-20)
    luck = jax.random.uniform(keys[3], shape)
    keep = hit & (luck < returned * (1.0 - limits.dropout)) & ~_is_hidden(azimuth, elevation, beams)
    keep = keep & (distance > limits.min_range) & (distance < limits.max_range)
    error = beams.range_offset[:, None, :] + limits.range_noise * jax.random.normal(keys[4], shape)
    point = _rotate(columns.R_out, point + error[None] * ray) + columns.t_out[:, None, :, None]
    normal = _rotate(columns.R_out, normal)
    return Measured(_by_ring(point), _by_ring(normal), _by_ring(primitive), _by_ring(keep))


def _by_ring(array: Shaped[Array, "... blocks columns rings"]) -> Shaped[Array, "... beams columns"]:
    array = jnp.swapaxes(array, -1, -2)
    return array.reshape(*array.shape[:-3], -1, array.shape[-1])


def _warp_hits(
    columns: Columns,
    warp: Warp,
    point: Float[Array, "3 blocks columns rings"],
    normal: Float[Array, "3 blocks columns rings"],
) -> tuple[Float[Array, "3 blocks columns rings"], Float[Array, "3 blocks columns rings"]]:
    """Points W(p) and normals J^-T n, in the frame of the sensor at each firing."""
    terms = evaluate(warp, point[0], point[1])
    lift = jnp.stack([jnp.zeros_like(terms.bend), terms.bend, terms.height])
    normal_y = normal[1] - terms.height_y * normal[2]
    normal = jnp.stack([normal[0] - terms.bend_x * normal_y - terms.height_x * normal[2], normal_y, normal[2]])
    normal = normal / jnp.linalg.norm(normal, axis=0, keepdims=True)
    point = point + lift - columns.warped_origin[:, None, :, None]
    return _rotate(columns.R_lidar_world, point), _rotate(columns.R_lidar_world, normal)


def _is_hidden(azimuth: Float[Array, "*n"], elevation: Float[Array, "*n"], beams: Beams) -> Bool[Array, "*n"]:
    """Whether the vehicle itself is in the way."""
    hidden = jnp.zeros(azimuth.shape, bool)
    for centre, half_width, top in beams.blind:
        offset = jnp.mod(azimuth - centre + jnp.pi, 2.0 * jnp.pi) - jnp.pi
        hidden = hidden | ((jnp.abs(offset) < half_width) & (elevation < top))
    return hidden


def _is_rough(y: Float[Array, "*n"], ground: Ground) -> Bool[Array, "*n"]:
    return (y > ground.left) | (y < ground.right)


def _ground_hit(rays: raycast.Rays, ground: Ground) -> Float[Array, "blocks columns rings"]:
    """Ray parameter of the plane z = 0, or of the grass above it."""
    down = -rays.direction[2]
    height = rays.origin[2][None, :, None]
    down = jnp.where(down > 1e-4, down, 1e-4)
    t = height / down
    y = rays.origin[1][None, :, None] + t * rays.direction[1]
    blade = jnp.where(_is_rough(y, ground), ground.grass_height, 0.004) * jnp.minimum(rays.depth, 3.0)
    return jnp.where(rays.direction[2] < -1e-4, (height - blade) / down, raycast.MISS)


def _flat_normal(
    time: Float[Array, " columns"],
    table: raycast.Table,
    primitive: Int[Array, "blocks columns rings"],
    point: Float[Array, "3 blocks columns rings"],
) -> Float[Array, "3 blocks columns rings"]:
    """Normal of the winner in the flat world; upwards on the ground."""
    values = jnp.moveaxis(table.values[primitive], -1, 0)
    o, _ = raycast.to_unit_frame(values, point, point, time[None, :, None])
    normal = raycast.unit_normal(table.shape[primitive], values, o)
    up = jnp.array([0.0, 0.0, 1.0]).reshape(3, 1, 1, 1)
    return jnp.where(primitive[None] < 0, up, normal)
