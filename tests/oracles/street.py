"""A street of turned boxes, ray-cast in float64 by the slab method: points, normals and planes known exactly."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

MAX_RANGE_M = 70.0
# centre x, y, half length, half width, height [m], yaw [deg]: facades with set-backs and gaps, cars, poles, a wall at each end
BOXES = np.array(
    [
        *([-30.0, 11.0, 9.0, 3.0, 9.0, 0.0], [-12.0, 12.5, 7.0, 3.0, 7.0, 2.0], [5.0, 11.2, 6.0, 3.0, 10.0, -1.0]),
        *([22.0, 12.0, 8.0, 3.0, 8.0, 0.0], [41.0, 11.0, 7.0, 3.0, 9.0, 3.0]),
        *([-27.0, -9.0, 8.0, 3.0, 8.0, 0.0], [-8.0, -10.5, 6.0, 3.0, 9.0, -2.0], [11.0, -9.4, 9.0, 3.0, 7.0, 1.0]),
        *([30.0, -10.2, 6.0, 3.0, 10.0, 0.0], [46.0, -9.0, 6.0, 3.0, 8.0, 0.0]),
        *([-45.0, 0.0, 1.0, 14.0, 6.0, 5.0], [58.0, 0.0, 1.0, 14.0, 6.0, -4.0]),
        *([-14.0, 4.6, 2.1, 0.9, 1.5, 1.0], [-4.0, 4.5, 2.1, 0.9, 1.5, -2.0], [9.0, 4.6, 2.1, 0.9, 1.5, 0.0]),
        *([17.0, 4.4, 2.4, 1.0, 2.2, 3.0], [-10.0, -4.2, 2.1, 0.9, 1.5, 0.0], [5.0, -4.3, 2.1, 0.9, 1.5, 4.0]),
        *([15.0, -4.2, 2.1, 0.9, 1.5, -3.0], [26.0, -4.3, 2.5, 1.0, 2.4, 0.0]),
        *([-18.0, 6.0, 0.15, 0.15, 6.0, 0.0], [1.0, 6.2, 0.15, 0.15, 6.0, 30.0], [20.5, 6.1, 0.15, 0.15, 6.0, 10.0]),
        *([-2.0, -6.0, 0.15, 0.15, 6.0, 20.0], [21.0, -6.1, 0.15, 0.15, 6.0, 45.0]),
    ]
).reshape(-1, 6)


class StreetScan(NamedTuple):
    """What a perfect sensor sees, in its own frame."""

    points: np.ndarray  # (n, 3) float32, with range noise if any
    normals: np.ndarray  # (n, 3) float64, towards the sensor
    offsets: np.ndarray  # (n,) the surface is the plane {x: normals . x = offsets}, exactly


def pose(x=0.0, y=0.0, z=1.7, *, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
    """T_world_lidar."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    T[:3, 3] = [x, y, z]
    return T


def _rays(num_rings, num_columns):
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-24, 12, num_rings)), np.arange(num_columns) * 2 * np.pi / num_columns)
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.stack([ray.ravel() for ray in rays], axis=1)


def _hit_box(origin, directions, box):
    """Distance and outward normal of the first face; infinity for a miss."""
    x, y, half_length, half_width, height, yaw_deg = box
    R = Rotation.from_euler("Z", yaw_deg, degrees=True).as_matrix()
    half = np.array([half_length, half_width, height / 2])
    local_origin, local = (origin - [x, y, height / 2]) @ R, directions @ R
    local = np.where(np.abs(local) < 1e-12, 1e-12, local)
    near = -(np.sign(local) * half + local_origin) / local
    far = (np.sign(local) * half - local_origin) / local
    entry, axis = near.max(axis=1), near.argmax(axis=1)
    rows = np.arange(len(local))
    face = np.zeros_like(local)
    face[rows, axis] = -np.sign(local[rows, axis])
    return np.where((entry > 0) & (entry < far.min(axis=1)), entry, np.inf), face @ R.T


def scan(T_world_lidar, *, noise_m=0.0, seed=0, num_rings=32, num_columns=720, boxes=BOXES):
    """A sweep from a pose, at one instant; `boxes` of length 0 leave the ground plane z = 0 alone."""
    rays = _rays(num_rings, num_columns)
    R, origin = T_world_lidar[:3, :3], T_world_lidar[:3, 3]
    directions = rays @ R.T
    down = directions[:, 2] < -1e-9
    best = np.where(down, -origin[2] / np.where(down, directions[:, 2], 1.0), np.inf)
    normals = np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    for box in boxes:
        distance, face = _hit_box(origin, directions, box)
        closer = distance < best
        best, normals = np.where(closer, distance, best), np.where(closer[:, None], face, normals)
    seen = best < MAX_RANGE_M
    rays, best, normals = rays[seen], best[seen], normals[seen] @ R
    offsets = np.sum(normals * rays * best[:, None], axis=1)
    noisy = best + noise_m * np.random.default_rng(seed).normal(size=len(best))
    return StreetScan((rays * noisy[:, None]).astype(np.float32), normals, offsets)
