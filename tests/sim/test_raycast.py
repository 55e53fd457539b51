"""Ray casting against brute force: bodies as inequalities, rays as dense float64 samples."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.sim import SENSORS, cull, make_motion, simulate_scan
from delo_jax.sim.primitives import Builder, Label, Shape
from delo_jax.sim.raycast import MISS, Work, first_return, to_unit_frame, unit_ball, unit_box, unit_cylinder, unit_normal
from delo_jax.sim.scenes import Ground, Scene, make_scene
from delo_jax.sim.warp import flat_warp

BODIES = {Shape.BOX: unit_box, Shape.CYLINDER: unit_cylinder, Shape.ELLIPSOID: unit_ball}
SENSOR = dataclasses.replace(SENSORS["hdl64e"], num_columns=512)


def inside(body, points, shrink=0.0):
    """Whether points (n, 3) lie inside a body (shape, center, half size, yaw), by the inequality that defines it."""
    shape, center, half_size, yaw = body
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y, z = (points - center).T
    u = np.stack([cos * x + sin * y, cos * y - sin * x, z]) / (half_size - shrink)[:, None]
    if shape == Shape.BOX:
        return np.abs(u).max(axis=0) <= 1.0
    if shape == Shape.CYLINDER:
        return (np.hypot(u[0], u[1]) <= 1.0) & (np.abs(u[2]) <= 1.0)
    return np.sum(u * u, axis=0) <= 1.0


def random_body(rng):
    center = rng.uniform([5.0, -3.0, -2.0], [40.0, 3.0, 2.0])
    return center, rng.uniform(0.2, 3.0, 3), rng.uniform(-np.pi, np.pi)


def unit_values(center, half_size, yaw):
    return jnp.array([*center, *half_size, np.cos(yaw), np.sin(yaw), 0.0, 0.0, 1.0, 0.0], jnp.float32)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize("seed", range(3))
def test_interval_inside_a_body(shape, seed):
    """Oracle: the body's defining inequality, sampled every 2 mm along each ray in float64."""
    rng = np.random.default_rng(seed)
    center, half_size, yaw = random_body(rng)
    aim = center + rng.uniform(-1.2, 1.2, (60, 3)) * half_size
    directions = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    origin, direction = jnp.zeros((3, 60), jnp.float32), jnp.asarray(directions.T, jnp.float32)
    o, d = to_unit_frame(unit_values(center, half_size, yaw), origin, direction, jnp.zeros(60))
    enter, leave = (np.asarray(t, np.float64) for t in BODIES[shape](o, d))
    t = np.arange(0.0, 60.0, 0.002)
    for ray, t_in, t_out in zip(directions, enter, leave, strict=True):
        sampled = t[inside((shape, center, half_size, yaw), t[:, None] * ray[None])]
        if len(sampled) > 5:
            assert abs(t_in - sampled[0]) < 0.004
            assert abs(t_out - sampled[-1]) < 0.004
        elif len(sampled) == 0:
            assert t_out - t_in < 0.01


def test_thin_pole_far_away_in_float32():
    """Oracle: closed form in float64; the textbook discriminant is off by metres here."""
    radius, distance = 0.03, 119.0
    offset = np.linspace(-0.95, 0.95, 21) * radius
    aim = np.stack([np.full(21, distance), offset, np.zeros(21)])
    direction = aim / np.linalg.norm(aim, axis=0)
    closest = distance * np.abs(direction[1])
    expected = distance * direction[0] - np.sqrt(radius**2 - closest**2)
    values = unit_values((distance, 0.0, 0.0), (radius, radius, 2.0), 0.3)
    o, d = to_unit_frame(values, jnp.zeros((3, 21)), jnp.asarray(direction, jnp.float32), jnp.zeros(21))
    enter, _ = unit_cylinder(o, d)
    np.testing.assert_allclose(enter, expected, atol=2e-3)


@pytest.mark.parametrize("shape", list(Shape))
def test_normals(shape):
    """Oracle: central differences, in float64, of the norm whose unit ball the body is."""
    rng = np.random.default_rng(int(shape))
    center, half_size, yaw = random_body(rng)
    cos, sin = np.cos(yaw), np.sin(yaw)
    points = center + half_size * rng.uniform(-0.5, 0.5, (40, 3))

    def norm(p):
        x, y, z = p - center
        u = np.abs(np.array([cos * x + sin * y, cos * y - sin * x, z]) / half_size)
        return {0: u.max(), 1: max(np.hypot(u[0], u[1]), u[2]), 2: np.linalg.norm(u)}[int(shape)]

    gradient = np.array([[norm(p + h) - norm(p - h) for h in 1e-6 * np.eye(3)] for p in points])
    expected = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    values = jnp.tile(unit_values(center, half_size, yaw)[:, None], (1, 40))
    world = jnp.asarray(points.T, jnp.float32)
    o, _ = to_unit_frame(values, world, world, jnp.zeros(40))
    normal = unit_normal(jnp.full(40, int(shape)), values, o)
    np.testing.assert_allclose(np.asarray(normal).T, expected, atol=2e-4)


def test_soft_and_transparent_bodies():
    """Oracle: the exponential distribution (mean, share that passes) and the stated opacity."""
    keys = jax.random.split(jax.random.PRNGKey(0))
    depth = jax.random.exponential(keys[0], (40_000,))
    luck = jax.random.uniform(keys[1], (40_000,))
    enter, leave = jnp.full(40_000, 10.0), jnp.full(40_000, 12.0)
    t = np.asarray(first_return(enter, leave, depth, luck, jnp.float32(0.6), jnp.float32(0.5)))
    hit = t < MISS
    assert hit.mean() == pytest.approx(0.6 * (1.0 - np.exp(-4.0)), abs=0.01)
    truncated_mean = 0.5 - 2.0 * np.exp(-4.0) / (1.0 - np.exp(-4.0))
    assert (t[hit] - 10.0).mean() == pytest.approx(truncated_mean, abs=0.01)
    assert t[hit].max() <= 12.0


def hard_scene(seed):
    """A flat scene of 120 solid standing bodies of all shapes."""
    rng = np.random.default_rng(seed)
    builder = Builder(rng)
    for _ in range(120):
        radius, angle = rng.uniform(5.0, 60.0), rng.uniform(-np.pi, np.pi)
        builder.begin(Label.CLUTTER, radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-3.0, 3.0))
        half_size = rng.uniform(0.05, 2.0, 3) * np.array([rng.choice([1.0, 4.0]), 1.0, 1.0])
        builder.add(Shape(int(rng.integers(3))), (0.0, 0.0, rng.uniform(0.0, 3.0)), tuple(half_size))
    ground = Ground(left=1e3, right=-1e3, grass_height=0.0, road_reflectance=0.2, grass_reflectance=0.2)
    return Scene(builder.build(), ground, flat_warp())


@pytest.mark.parametrize("seed", range(2))
def test_hits_are_on_their_object_and_nothing_is_in_front(seed):
    """Oracle: brute force over all primitives in float64, no culling; the path to each hit is free."""
    scene, motion = hard_scene(seed), make_motion(seed, 0.3, turning=True, max_speed=0.0)
    scan = simulate_scan(scene, motion, 0.0, SENSOR, jax.random.PRNGKey(seed), rolling_shutter=False, noise=False)
    chosen = np.random.default_rng(seed).choice(len(scan.points), 150, replace=False)
    hits = scan.points[chosen].astype(np.float64) @ scan.T_world_lidar[:3, :3].T + scan.T_world_lidar[:3, 3]
    origin = scan.T_world_lidar[:3, 3]
    bodies = list(zip(*scene.primitives[:4], strict=True))
    for hit, object_id in zip(hits, scan.object_ids[chosen], strict=True):
        path = origin + np.linspace(0.0, 0.998, 600)[:, None] * (hit - origin)[None]
        for body, identity in zip(bodies, scene.primitives.object_id, strict=True):
            assert not inside(body, path, shrink=0.003).any()
            if identity == object_id:
                assert inside(body, hit[None], shrink=-0.003).all()
        assert object_id > 0 or -0.003 < hit[2] < 0.015  # the road is rough by a few millimetres
    assert np.mean(scan.object_ids > 0) > 0.05


@pytest.mark.parametrize("kind", ["urban", "open"])
def test_culling_loses_no_hit(kind, monkeypatch):
    """Oracle: the same scan with every primitive tested against every tile."""
    scene, motion = make_scene(kind, 0), make_motion(3, 0.3, start_x=60.0)
    arguments = scene, motion, 0.0, SENSOR, jax.random.PRNGKey(0)
    culled = simulate_scan(*arguments, rolling_shutter=True, noise=False)

    def everything(primitives, origin, wedges, starts, **slack):
        shape = len(primitives.shape), *wedges.lowest.shape
        primitive, group, block = (index.astype(np.int32) for index in np.indices(shape).reshape(3, -1))
        ends = np.searchsorted(primitives.shape[primitive], [0, 1, 2], side="right").astype(np.int32)
        assert len(primitive) <= 262144
        pad = (0, 262144 - len(primitive))
        return Work(np.pad(primitive, pad), np.pad(block, pad), np.pad(starts[group], pad), ends)

    monkeypatch.setattr(cull, "find_work", everything)
    full = simulate_scan(*arguments, rolling_shutter=True, noise=False)
    np.testing.assert_array_equal(full.points, culled.points)
    np.testing.assert_array_equal(full.object_ids, culled.object_ids)
