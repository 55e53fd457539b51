"""A run's folder, read again."""

import csv
import json
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from delo_jax.errors import DatasetError


def facts_of(folder: Path) -> dict[str, Any]:
    """What run.json says.

    Raises:
        DatasetError: no run, or a damaged one.
    """
    try:
        facts = json.loads((folder / "run.json").read_text())
    except OSError as error:
        raise DatasetError(
            f"{folder}: expected the folder of a run, got no readable run.json in it ({error.strerror}); check the path"
        ) from error
    except ValueError as error:
        raise DatasetError(f"{folder / 'run.json'}: expected JSON, got {error}; run again") from error
    if not isinstance(facts, dict):
        raise DatasetError(f"{folder / 'run.json'}: expected a table, got {type(facts).__name__}; run again")
    return facts


def poses_of(folder: Path, facts: dict[str, Any], name: str = "poses_kitti.txt") -> tuple[np.ndarray, np.ndarray]:
    """Stamps and sensor poses of a run; a kill between two files leaves one a frame longer."""
    from delo_jax.data.poses import read_kitti_poses, read_tum

    poses = to_lidar(read_kitti_poses(folder / name), facts)
    stamps_ns, _ = read_tum(folder / "trajectory.tum")
    count = min(len(poses), len(stamps_ns))
    return stamps_ns[:count], poses[:count]


def to_lidar(poses: np.ndarray, facts: dict[str, Any]) -> np.ndarray:
    """Sensor poses of the rows of a KITTI file that is in the frame of the run's own."""
    from delo_jax.data.poses import camera_to_lidar

    T_cam_lidar = facts.get("T_cam_lidar")
    return poses if T_cam_lidar is None else camera_to_lidar(poses, np.array(T_cam_lidar, np.float64))


class StoredFrames(NamedTuple):
    """What a run's files say of its frames."""

    stamps_ns: np.ndarray  # (n,)
    Ts_world_lidar: np.ndarray  # (n, 4, 4)
    since: np.ndarray  # (n,) number of the frame that each motion starts from
    rejected: np.ndarray  # (n,)
    covariances: np.ndarray  # (n, 6, 6) of the poses
    local: np.ndarray  # (n, 6, 6) the part that later poses do not inherit


def frames_of(folder: Path, facts: dict[str, Any]) -> StoredFrames:
    """Whole frames of a run.

    Raises:
        DatasetError: a file that is missing or damaged.
    """
    stamps_ns, Ts = poses_of(folder, facts)
    try:
        with (folder / "frames.csv").open(newline="") as file:
            table = list(csv.DictReader(file))
        covariances, local = (np.load(folder / f"{name}_covariances.npy") for name in ("pose", "local"))
        since = np.array([int(row["since_index"]) for row in table], np.int64)
        rejected = np.array([row["status"] == "rejected" for row in table])
    except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder}: expected the files of a run, got {error}; run again") from error
    count = min(len(Ts), len(table), len(covariances), len(local))
    return StoredFrames(*(array[:count] for array in (stamps_ns, Ts, since, rejected, covariances, local)))


def options_of(folder: Path) -> dict[str, Any]:
    """Options that the run was started with.

    Raises:
        DatasetError: no readable config.toml.
    """
    try:
        return tomllib.loads((folder / "config.toml").read_text())["run"]
    except (OSError, KeyError, tomllib.TOMLDecodeError) as error:
        raise DatasetError(f"{folder}: expected a config.toml with the options of a run, got {error}; run again") from error
