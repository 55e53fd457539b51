"""A simulated drive as a source of scans."""

import numpy as np

from delo_jax.data.fields import FRAME_PERIOD_NS, RawScan
from delo_jax.sim import simulate_drive


class SimulatedDrive:
    """Scans as measured by the moving sensor, simulated as they are asked for, in order."""

    name = "simulated drive"
    T_cam_lidar = None

    def __init__(self, kind: str, seed: int, num_scans: int):
        self._drive = simulate_drive(kind, seed, num_scans, rolling_shutter=True)
        self._Ts_world_lidar: list[np.ndarray] = []
        self.stamps_ns = FRAME_PERIOD_NS * np.arange(num_scans)
        self.paths = tuple(f"simulated scan {index}" for index in range(num_scans))
        self.kept: dict[int, RawScan] = {}
        """A dozen scans of the drive, for a picture of the scene."""
        self._stride = max(1, num_scans // 12)

    def __len__(self) -> int:
        """Number of scans of the whole drive."""
        return len(self.paths)

    def __getitem__(self, index: int) -> RawScan:
        """The next scan; `index` counts up."""
        scan = next(self._drive)
        self._Ts_world_lidar.append(scan.T_world_lidar)
        raw = RawScan(scan.points, scan.times_s)
        if index % self._stride == 0:
            self.kept[index] = raw
        return raw

    @property
    def truth(self) -> np.ndarray:
        """Poses so far, in the frame of the first scan."""
        Ts = np.array(self._Ts_world_lidar).reshape(-1, 4, 4)
        return np.linalg.inv(Ts[:1]) @ Ts
