"""A LiDAR simulator: random road worlds, vehicle motion, spinning sensors, exact truth."""

from delo_jax.sim.drive import simulate_clip, simulate_drive
from delo_jax.sim.motion import Motion, make_motion, pose_at
from delo_jax.sim.route import simulate_route
from delo_jax.sim.scan import SimulatedScan, simulate_scan
from delo_jax.sim.scenes import KINDS, Scene, clear_path, make_scene
from delo_jax.sim.sensors import SENSORS, Sensor, SensorUnit, draw_unit

__all__ = [
    "KINDS",
    "SENSORS",
    "Motion",
    "Scene",
    "Sensor",
    "SensorUnit",
    "SimulatedScan",
    "clear_path",
    "draw_unit",
    "make_motion",
    "make_scene",
    "pose_at",
    "simulate_clip",
    "simulate_drive",
    "simulate_route",
    "simulate_scan",
]
