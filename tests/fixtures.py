"""Small problems for many tests: a tiny network, pairs of the analytic street, one simulated clip. Made once per session."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np

from delo_jax.config import DeloConfig, EncoderConfig, EvidenceConfig, FineConfig, PreprocessConfig, TrainConfig
from delo_jax.model import delo
from delo_jax.preprocess import Scan, preprocess
from delo_jax.sim import simulate_clip
from delo_jax.train.presets import PRESETS
from delo_jax.train.worlds import World, stored_config
from tests.oracles import street

TINY = DeloConfig(
    name="tiny",
    preprocess=PreprocessConfig(point_voxel_m=1.2, max_points=512, num_keypoints=64, keypoint_voxel_m=2.5),
    encoder=EncoderConfig(num_neighbors=6, width=8, embedding_dim=64),
    fine=FineConfig(num_points=256, num_iters=4, point_width=8, point_dim=4, edge_width=8),
    evidence=EvidenceConfig(width=8),
)

TINY_TRAINING = TrainConfig(
    model=dataclasses.replace(
        TINY,
        preprocess=PreprocessConfig(point_voxel_m=2.0, max_points=128, num_keypoints=32, keypoint_voxel_m=2.5),
        fine=dataclasses.replace(TINY.fine, num_points=64, num_iters=2),
    ),
    batch_size=2,
    num_points=64,
    num_iters=2,
    num_scenes=2,
    num_validation_scenes=1,
)


def narrow(name: str, num_points: int = 64) -> TrainConfig:
    """A preset with everything that makes it what it is, an eighth as wide, on few points."""
    preset = PRESETS[name]
    cfg = preset.model
    raw = cfg.preprocess.sampling == "raw"
    few = {"max_points": num_points, "num_keypoints": num_points if raw else num_points // 2}
    spread = {} if raw else {"point_voxel_m": 2.0, "keypoint_voxel_m": 2.5}
    model = dataclasses.replace(
        cfg,
        preprocess=dataclasses.replace(cfg.preprocess, **few, **spread),
        encoder=dataclasses.replace(cfg.encoder, num_neighbors=6, width=8, embedding_dim=32),
        attention=dataclasses.replace(cfg.attention, hidden=64),
        fine=dataclasses.replace(cfg.fine, num_points=32, num_iters=min(cfg.fine.num_iters, 2), point_width=8, point_dim=4, edge_width=8),
        evidence=dataclasses.replace(cfg.evidence, width=8),
    )
    return dataclasses.replace(preset, model=model, batch_size=2, num_points=32, num_iters=2, num_scenes=2, num_validation_scenes=1)


QUICKLY: dict[str, Any] = {"xla_backend_optimization_level": 0}  # to compile what runs once: half the time, up to rounding the same


@functools.cache
def narrow_model(name: str, num_points: int = 64) -> delo.Model:
    """Untrained weights of a narrow preset."""
    return jax.jit(delo.init, static_argnums=0, compiler_options=QUICKLY)(narrow(name, num_points).model, jax.random.key(0))


@functools.cache
def tiny_model() -> delo.Model:
    """Untrained weights of the tiny network."""
    return jax.jit(functools.partial(delo.init, TINY))(jax.random.key(0))


def street_poses() -> tuple[np.ndarray, np.ndarray]:
    """T_world_source and T_world_target: 1.2 m, 3 deg and a little roll and pitch apart."""
    return street.pose(), street.pose(1.2, 0.1, 1.75, yaw_deg=3.0, pitch_deg=0.4, roll_deg=-0.3)


@functools.cache
def street_points(frame: int) -> np.ndarray:
    """Source (0) or target (1) points of the street, with 1 cm of range noise."""
    points = street.scan(street_poses()[frame], noise_m=0.01, seed=frame).points
    points.flags.writeable = False
    return points


@functools.cache
def street_scan(frame: int) -> Scan:
    """The same, preprocessed for the tiny network."""
    return preprocess(street_points(frame), TINY.preprocess)


def dirty(scan, seed=0):
    """The scan with garbage in its padding."""
    rng = np.random.default_rng(seed)
    garbage = {name: 50 * rng.normal(size=array.shape) for name, array in scan._asdict().items() if array.ndim == 2 and len(array)}
    filled = {name: np.where(scan.mask[:, None], getattr(scan, name), array).astype(np.float32) for name, array in garbage.items()}
    index = np.where(scan.keypoint_mask, scan.keypoint_index, rng.integers(0, len(scan.mask), len(scan.keypoint_index)))
    return scan._replace(**filled, keypoint_index=index.astype(np.int32))


def thinned(scan, num_points, num_keypoints):
    """The scan with fewer valid rows and key points."""
    keypoint_mask = np.arange(len(scan.keypoint_mask)) < num_keypoints
    index = np.where(keypoint_mask, scan.keypoint_index % num_points, 0).astype(np.int32)
    mask = np.arange(len(scan.mask)) < num_points
    points, normals, features = (np.where(mask[:, None], array, 0).astype(np.float32) if len(array) else array for array in scan[:3])
    return Scan(points, normals, features, mask, index, keypoint_mask)


def T_street() -> np.ndarray:
    """T_target_source of the street's pair, float64."""
    T_world_source, T_world_target = street_poses()
    return np.linalg.inv(T_world_target) @ T_world_source


def errors(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Translation error [m] and rotation error [deg]."""
    error = np.linalg.inv(np.asarray(T, np.float64)) @ T_true
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(np.linalg.norm(error[:3, :3] - np.eye(3)) / np.sqrt(2)))


@functools.cache
def street_world(cfg: PreprocessConfig, num_frames: int = 6) -> World:
    """The street as a training world: a sensor that drives and turns, 0.9 m a frame."""
    poses = [street.pose(0.9 * k - 6.0, 0.1 * k, 1.7 + 0.01 * k, yaw_deg=2.0 * k, roll_deg=0.2 * k) for k in range(num_frames)]
    scans = [preprocess(street.scan(T, noise_m=0.01, seed=k).points, stored_config(cfg)) for k, T in enumerate(poses)]
    return World(Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True))), np.array(poses))


@functools.cache
def simulated_world(cfg: PreprocessConfig) -> World:
    """The simulated clip as a training world."""
    scans = [preprocess(scan.points, cfg) for scan in simulated_clip()]
    poses = np.array([scan.T_world_lidar for scan in simulated_clip()])
    return World(Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True))), poses)


@functools.cache
def simulated_clip() -> list:
    """Three scans of a simulated street as a 16-beam sensor sees it, with exact poses."""
    return simulate_clip("urban", 4, num_frames=3, sensor="vlp16", num_columns=720, rolling_shutter_share=0.0)
