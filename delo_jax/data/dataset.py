"""Opens whatever a user points at: a KITTI odometry sequence or root, a KITTI raw drive or its day, or a folder of scans."""

from pathlib import Path

from delo_jax.data.folder import open_folder
from delo_jax.data.kitti import open_odometry, open_raw, scan_paths
from delo_jax.data.sequence import Dataset
from delo_jax.errors import DatasetError

__all__ = ["Dataset", "open_dataset"]


def open_dataset(
    path: str | Path, *, sequence: str | None = None, elevation_correction: bool = True, azimuth_times: bool = False
) -> Dataset:
    """Dataset of the layout found at `path`.

    Args:
        path: a sequence, a drive, a folder of scans, or a folder that holds several of the former two.
        sequence: name of the sequence or drive where `path` holds several.
        elevation_correction: correct the vertical angles of KITTI's scans by 0.205 deg; never done in plain folders.
        azimuth_times: the scans are as measured, by a sensor that turns like KITTI's: give points without stored times theirs by
            azimuth. KITTI raw drives always get them.

    Raises:
        DatasetError: nothing there that can be read, or several sequences and none named.
    """
    root = Path(path)
    try:
        if not root.is_dir():
            found = "a file" if root.exists() else "nothing"
            raise DatasetError(f"{root}: expected a folder of scans, got {found}; check the path")
        folder = _select(_enclosing(root), sequence)
        if _is_odometry(folder):
            return open_odometry(folder, elevation_correction=elevation_correction, azimuth_times=azimuth_times)
        if _is_raw(folder):
            return open_raw(folder, elevation_correction=elevation_correction)
        return open_folder(folder, azimuth_times=azimuth_times)
    except OSError as error:
        raise DatasetError(f"{root}: expected a readable folder, got {error.strerror or error}; check its permissions") from None


def _select(root, sequence):
    """The one sequence or drive in `root`, or `root` itself."""
    folders = [root] if _is_odometry(root) or _is_raw(root) else _sequences(root)
    found = {folder.name: folder for folder in folders}
    if sequence is not None:
        if sequence not in found:
            raise DatasetError(f"{root}: expected a sequence {sequence!r}, got {', '.join(found) or 'none'}; name one of these")
        return found[sequence]
    if len(found) > 1:
        raise DatasetError(f"{root}: expected one sequence, got {', '.join(found)}; name one of these")
    return next(iter(found.values()), root)


def _sequences(root):
    """Odometry sequences of a tree, else the raw drives in it."""
    for parent in (root / "sequences", root / "dataset" / "sequences", root):
        found = [folder for folder in sorted(parent.glob("*")) if _is_odometry(folder)]
        if found:
            return found
    for pattern in ("*", "*/*"):
        found = [folder for folder in sorted(root.glob(pattern)) if _is_raw(folder)]
        if found:
            return found
    return []


def _enclosing(folder):
    """The sequence or drive of a folder that is only its scans: users point there, and truth would be lost."""
    resolved = folder.resolve()
    if resolved.name == "velodyne" and (resolved.parent / "calib.txt").exists():
        return resolved.parent
    if resolved.parts[-2:] == ("velodyne_points", "data"):
        return resolved.parent.parent
    return resolved.parent if resolved.name == "velodyne_points" else resolved


def _is_odometry(folder):
    return (folder / "velodyne").is_dir() and bool(scan_paths(folder / "velodyne"))


def _is_raw(folder):
    return (folder / "velodyne_points" / "data").is_dir() and bool(scan_paths(folder / "velodyne_points" / "data"))
