"""Ray casting in the flat world: one pure function per shape, the nearest hit over all of them.

A shape is a unit body, scaled, turned and moved; rays are brought into its unit frame, where each
function returns the interval of ray parameters inside the body. Rays are laid out in tiles
(block of rings, columns, rings of the block): a pair (shape, tile) that may meet is a work item,
listed by `cull.py`, so the cost is that of the pairs that matter and shapes never recompile.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from delo_jax.sim.sensors import COLUMNS_PER_GROUP

MISS = 1e6
"""Ray parameter of a ray that meets nothing; finite, since it is multiplied later."""


class Rays(NamedTuple):
    """Rays in the flat world, counted from a local origin; directions are about unit length."""

    origin: Float[Array, "3 columns"]
    direction: Float[Array, "3 blocks columns rings"]
    time: Float[Array, " columns"]
    """Of emission, relative to the stamp [s]."""
    depth: Float[Array, "blocks columns rings"]
    """Optical depth that the ray can pass, drawn from Exp(1)."""
    luck: Float[Array, "blocks columns rings"]
    """Uniform in [0, 1): decides at part-transparent shapes."""


class Work(NamedTuple):
    """Pairs of shape and tile to be tested, boxes first, then cylinders, then ellipsoids."""

    primitive: Int[Array, " items"]
    block: Int[Array, " items"]
    start: Int[Array, " items"]
    """First column of the tile."""
    ends: Int[Array, " 3"]
    """Where each shape's items end."""


class Table(NamedTuple):
    """Primitives on the device, positions at the stamp, counted from the local origin."""

    shape: Int[Array, " p"]
    values: Float[Array, "p 12"]
    """center (3), half_size (3), cos and sin of yaw, velocity (2), opacity, softness."""


def unit_box(o: Float[Array, "3 ..."], d: Float[Array, "3 ..."]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Where o + t d enters and leaves the cube [-1, 1]^3; entry > exit for a miss."""
    inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
    near, far = (-1.0 - o) * inverse, (1.0 - o) * inverse
    return jnp.max(jnp.minimum(near, far), axis=0), jnp.min(jnp.maximum(near, far), axis=0)


def unit_cylinder(o: Float[Array, "3 ..."], d: Float[Array, "3 ..."]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Where o + t d enters and leaves x^2 + y^2 <= 1, |z| <= 1; entry > exit for a miss.

    The discriminant is written with the cross product: b^2 - a c cancels to nothing in float32
    for a thin pole far away.
    """
    a = jnp.maximum(d[0] ** 2 + d[1] ** 2, 1e-12)
    middle = -(o[0] * d[0] + o[1] * d[1])
    root_squared = a - (o[0] * d[1] - o[1] * d[0]) ** 2
    root = jnp.sqrt(jnp.maximum(root_squared, 0.0))
    inverse = 1.0 / jnp.where(jnp.abs(d[2]) < 1e-9, 1e-9, d[2])
    near, far = (-1.0 - o[2]) * inverse, (1.0 - o[2]) * inverse
    enter = jnp.maximum((middle - root) / a, jnp.minimum(near, far))
    leave = jnp.minimum((middle + root) / a, jnp.maximum(near, far))
    return jnp.where(root_squared > 0.0, enter, MISS), jnp.where(root_squared > 0.0, leave, -MISS)


def unit_ball(o: Float[Array, "3 ..."], d: Float[Array, "3 ..."]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Where o + t d enters and leaves the unit ball; entry > exit for a miss."""
    a = d[0] ** 2 + d[1] ** 2 + d[2] ** 2
    middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2])
    cross = (o[1] * d[2] - o[2] * d[1]) ** 2 + (o[2] * d[0] - o[0] * d[2]) ** 2 + (o[0] * d[1] - o[1] * d[0]) ** 2
    root_squared = a - cross
    root = jnp.sqrt(jnp.maximum(root_squared, 0.0))
    hit = root_squared > 0.0
    return jnp.where(hit, (middle - root) / a, MISS), jnp.where(hit, (middle + root) / a, -MISS)


def first_return(
    enter: Float[Array, "*n"],
    leave: Float[Array, "*n"],
    depth: Float[Array, "*n"],
    luck: Float[Array, "*n"],
    opacity: Float[Array, ""],
    softness: Float[Array, ""],
) -> Float[Array, "*n"]:
    """Ray parameter at which a body returns the ray, `MISS` where it lets it pass.

    A ray goes on for `depth * softness` below the surface; it passes if that is beyond the far side.
    """
    t = jnp.maximum(enter, 0.0) + softness * depth
    return jnp.where((enter <= leave) & (t <= leave) & (luck < opacity), t, MISS)


def nearest_hit(rays: Rays, table: Table, work: Work) -> tuple[Float[Array, "blocks columns rings"], Int[Array, "blocks columns rings"]]:
    """Ray parameter and primitive of the first return; `MISS` and -1 where there is none."""
    best = jnp.full_like(rays.depth, MISS), jnp.full(rays.depth.shape, -1, jnp.int32)
    start = jnp.int32(0)
    for body, end in zip((unit_box, unit_cylinder, unit_ball), work.ends, strict=True):
        best = jax.lax.fori_loop(start, end, _tester(body, rays, table, work), best)
        start = end
    return best


def _tester(body: Callable, rays: Rays, table: Table, work: Work) -> Callable:
    """Loop body that tests one work item and keeps the nearer return."""
    num_rings = rays.direction.shape[3]
    tile_shape = (1, COLUMNS_PER_GROUP, num_rings)

    def test(i, best):
        index, corner = work.primitive[i], (work.block[i], work.start[i], jnp.int32(0))
        values = jax.lax.dynamic_index_in_dim(table.values, index, keepdims=False)

        def tile(array):
            return jax.lax.dynamic_slice(array, corner, tile_shape)

        direction = jax.lax.dynamic_slice(rays.direction, (jnp.int32(0), *corner), (3, *tile_shape))
        origin = jax.lax.dynamic_slice(rays.origin, (jnp.int32(0), corner[1]), (3, COLUMNS_PER_GROUP))
        time = jax.lax.dynamic_slice(rays.time, (corner[1],), (COLUMNS_PER_GROUP,))
        o, d = to_unit_frame(values, origin[:, None, :, None], direction, time[None, :, None])
        luck = jnp.mod(tile(rays.luck) + 0.618034 * index.astype(jnp.float32), 1.0)
        enter, leave = body(o, d)
        t = first_return(enter, leave, tile(rays.depth), luck, values[10], values[11])
        t_best, index_best = tile(best[0]), tile(best[1])
        nearer = t < t_best
        return (
            jax.lax.dynamic_update_slice(best[0], jnp.where(nearer, t, t_best), corner),
            jax.lax.dynamic_update_slice(best[1], jnp.where(nearer, index, index_best), corner),
        )

    return test


def to_unit_frame(
    values: Float[Array, " 12"] | Float[Array, "12 ..."],
    origin: Float[Array, "3 ..."],
    direction: Float[Array, "3 ..."],
    time: Float[Array, "*c"],
) -> tuple[Float[Array, "3 ..."], Float[Array, "3 ..."]]:
    """Rays in the frame where the primitive is a unit body; the ray parameter stays the same."""
    x, y, z, half_x, half_y, half_z, cos, sin, velocity_x, velocity_y = values[:10]
    x, y, z = origin[0] - x - velocity_x * time, origin[1] - y - velocity_y * time, origin[2] - z
    o = jnp.stack([(cos * x + sin * y) / half_x, (cos * y - sin * x) / half_y, z / half_z])
    x, y, z = direction
    d = jnp.stack([(cos * x + sin * y) / half_x, (cos * y - sin * x) / half_y, z / half_z])
    return o, d


def unit_normal(shape: Int[Array, "*n"], values: Float[Array, "12 ..."], point: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Outward normal in the flat world at a point of the unit frame, on or below the surface.

    It is the gradient of the body's norm; a box has that of the face nearest to the point.
    """
    size = jnp.abs(point)
    face = jnp.where(size >= jnp.max(size, axis=0, keepdims=True), jnp.sign(point), 0.0)
    side = jnp.stack([point[0], point[1], jnp.zeros_like(point[2])])
    radial = jnp.sqrt(point[0] ** 2 + point[1] ** 2)
    cylinder = jnp.where(size[2:] > radial[None], face * jnp.array([0.0, 0.0, 1.0]).reshape(3, *[1] * shape.ndim), side)
    gradient = jnp.where(shape[None] == 0, face, jnp.where(shape[None] == 1, cylinder, point))
    x, y, z = gradient / values[3:6]
    cos, sin = values[6], values[7]
    normal = jnp.stack([cos * x - sin * y, sin * x + cos * y, z])
    return normal / jnp.maximum(jnp.linalg.norm(normal, axis=0, keepdims=True), 1e-9)
