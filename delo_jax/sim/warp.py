"""A smooth map from the flat world, where rays are cast, to a world with bends, slopes and banks.

W(x, y, z) = (x, y + bend(x), z + height(x, y)), height = terrain + banks + bumps of the verge. Each
static point of the flat world has one place in the warped world, so the warped world is as rigid as
the flat one. Its Jacobian is

    J = [[1, 0, 0], [bend_x, 1, 0], [height_x, height_y, 1]].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

AnyArray = jax.Array | np.ndarray


class Warp(NamedTuple):
    """Coefficients; lengths in metres, wave numbers in rad/m, phases in rad."""

    bend: Float[AnyArray, "bends 3"]
    """Rows amplitude, wave number, phase: bend(x) = sum a sin(k x + p)."""
    terrain: Float[AnyArray, "waves 4"]
    """Rows amplitude, wave numbers along x and y, phase."""
    banks: Float[AnyArray, "banks 6"]
    """Rows height, side (+1 left, -1 right), lateral offset, width, wave number, phase: a ramp
    h/2 (1 + tanh((side y - offset) / width)) whose height swells along the road."""
    bumps: Float[AnyArray, "bumps 6"]
    """Rows as of `terrain`, then side and lateral offset where the wave fades in over a metre."""


class WarpTerms(NamedTuple):
    """Values and slopes of the warp at given points of the flat world."""

    bend: Float[AnyArray, "*n"]
    bend_x: Float[AnyArray, "*n"]
    height: Float[AnyArray, "*n"]
    height_x: Float[AnyArray, "*n"]
    height_y: Float[AnyArray, "*n"]


def flat_warp() -> Warp:
    """The identity."""
    banks = np.array([[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]])
    return Warp(np.zeros((1, 3)), np.zeros((1, 4)), banks, np.zeros((1, 6)))


def evaluate(warp: Warp, x: Float[AnyArray, "*n"], y: Float[AnyArray, "*n"]) -> WarpTerms:
    """The warp's terms at (x, y), in NumPy or in JAX as the points are."""
    xp = jnp if isinstance(x, jax.Array) else np
    bend = bend_x = height = height_x = height_y = xp.zeros_like(x)
    for a, k, phase in zip(*_columns(warp.bend), strict=True):
        bend, bend_x = bend + a * xp.sin(k * x + phase), bend_x + a * k * xp.cos(k * x + phase)
    for a, kx, ky, phase in zip(*_columns(warp.terrain), strict=True):
        angle = kx * x + ky * y + phase
        height = height + a * xp.sin(angle)
        height_x, height_y = height_x + a * kx * xp.cos(angle), height_y + a * ky * xp.cos(angle)
    for h, side, offset, width, k, phase in zip(*_columns(warp.banks), strict=True):
        ramp = xp.tanh((side * y - offset) / width)
        swell = 1.0 + 0.4 * xp.sin(k * x + phase)
        height = height + 0.5 * h * swell * (1.0 + ramp)
        height_x = height_x + 0.5 * h * 0.4 * k * xp.cos(k * x + phase) * (1.0 + ramp)
        height_y = height_y + 0.5 * h * swell * (1.0 - ramp * ramp) * side / width
    for a, kx, ky, phase, side, offset in zip(*_columns(warp.bumps), strict=True):
        angle, ramp = kx * x + ky * y + phase, xp.tanh(side * y - offset)
        share, wave, slope = 0.5 * a * (1.0 + ramp), xp.sin(angle), xp.cos(angle)
        height = height + share * wave
        height_x = height_x + share * kx * slope
        height_y = height_y + share * ky * slope + 0.5 * a * (1.0 - ramp * ramp) * side * wave
    return WarpTerms(bend, bend_x, height, height_x, height_y)


def _columns(rows: AnyArray) -> list[AnyArray]:
    return [rows[:, j] for j in range(rows.shape[1])]


def rebase(warp: Warp, x: float, y: float) -> Warp:
    """The same warp for coordinates counted from (x, y): keeps float32 exact far along a road."""
    bend, terrain, banks, bumps = (np.array(rows, dtype=np.float64) for rows in warp)
    bend[:, 2] = np.mod(bend[:, 2] + bend[:, 1] * x, 2.0 * np.pi)
    for waves in (terrain, bumps):
        waves[:, 3] = np.mod(waves[:, 3] + waves[:, 1] * x + waves[:, 2] * y, 2.0 * np.pi)
    banks[:, 2] -= banks[:, 1] * y
    bumps[:, 5] -= bumps[:, 4] * y
    banks[:, 5] = np.mod(banks[:, 5] + banks[:, 4] * x, 2.0 * np.pi)
    return Warp(bend, terrain, banks, bumps)


def jacobian(terms: WarpTerms) -> Float[np.ndarray, "n 3 3"]:
    """J at the points where the terms were taken."""
    J = np.tile(np.eye(3), (len(terms.bend_x), 1, 1))
    J[:, 1, 0], J[:, 2, 0], J[:, 2, 1] = terms.bend_x, terms.height_x, terms.height_y
    return J


def warp_poses(warp: Warp, Ts_flat_lidar: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Sensor poses in the warped world.

    The rotation is J R made orthonormal from its first axis on: forward stays the tangent of the
    path, so the vehicle neither slides sideways in a bend nor noses into a slope.

    Returns:
        Ts_world_lidar.
    """
    position = Ts_flat_lidar[:, :3, 3]
    terms = evaluate(warp, position[:, 0], position[:, 1])
    axes = jacobian(terms) @ Ts_flat_lidar[:, :3, :3]
    forward = axes[:, :, 0] / np.linalg.norm(axes[:, :, 0], axis=1, keepdims=True)
    up = np.cross(forward, axes[:, :, 1])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    Ts_world_lidar = np.tile(np.eye(4), (len(position), 1, 1))
    Ts_world_lidar[:, :3, :3] = np.stack([forward, np.cross(up, forward), up], axis=2)
    Ts_world_lidar[:, :3, 3] = position
    Ts_world_lidar[:, 1, 3] += terms.bend
    Ts_world_lidar[:, 2, 3] += terms.height
    return Ts_world_lidar


def max_curvature(warp: Warp) -> float:
    """Bound on the curvature of the road [1/m]."""
    return float(np.sum(np.abs(warp.bend[:, 0]) * warp.bend[:, 1] ** 2))


def draw_warp(rng: np.random.Generator, *, max_slope: float, max_bend: float, banks: bool, verge: tuple[float, float]) -> Warp:
    """A random warp.

    Args:
        rng: source of randomness.
        max_slope: bound on the steepness of the terrain.
        max_bend: bound on d bend / dx; about the tangent of the largest heading of the road.
        banks: whether embankments and ditches run along the road.
        verge: distances to the left and to the right at which the ground becomes uneven [m].
    """
    wavelengths = rng.uniform([90.0, 180.0, 350.0], [160.0, 350.0, 900.0])
    k = 2.0 * np.pi / wavelengths
    share = rng.dirichlet(np.ones(3)) * max_bend * rng.uniform(0.0, 1.0)
    # Curvature above 1/60 per metre would fold the verge onto itself.
    share = np.minimum(share, 1.0 / 60.0 / k)
    bend = np.stack([share / k, k, rng.uniform(0.0, 2.0 * np.pi, 3)], axis=1)

    wavelengths = np.repeat(rng.uniform([14.0, 50.0, 150.0], [30.0, 110.0, 500.0]), 2)
    heading = rng.uniform(-np.pi, np.pi, 6)
    k = 2.0 * np.pi / wavelengths
    steepness = rng.dirichlet(np.ones(6)) * max_slope * rng.uniform(0.0, 1.0)
    steepness[:2] *= 0.2
    terrain = np.stack([steepness / k, k * np.cos(heading), k * np.sin(heading), rng.uniform(0.0, 2.0 * np.pi, 6)], axis=1)
    return Warp(bend, terrain, _draw_banks(rng, banks), _draw_bumps(rng, verge))


def _draw_banks(rng: np.random.Generator, present: bool) -> Float[np.ndarray, "4 6"]:
    rows = []
    for side in (1.0, -1.0, 1.0, -1.0):
        height = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 4.0) * (rng.uniform() < 0.75) * present
        width = abs(height) * rng.uniform(0.6, 2.0) + 0.4
        offset = rng.uniform(6.0, 16.0) + width
        k, phase = 2.0 * np.pi / rng.uniform(40.0, 200.0), rng.uniform(0.0, 2.0 * np.pi)
        rows.append([height, side, offset, width, k, phase])
    return np.array(rows)


def _draw_bumps(rng: np.random.Generator, verge: tuple[float, float]) -> Float[np.ndarray, "4 6"]:
    rows = []
    for side, offset in ((1.0, verge[0]), (-1.0, verge[1])):
        for longest in (5.0, 14.0):
            wavelength, heading = rng.uniform(0.5, 1.0) * longest, rng.uniform(-np.pi, np.pi)
            k, a = 2.0 * np.pi / wavelength, wavelength * rng.uniform(0.0, 0.02)
            rows.append([a, k * np.cos(heading), k * np.sin(heading), rng.uniform(0.0, 2.0 * np.pi), side, offset + 1.0])
    return np.array(rows)
