"""Training worlds from recorded sequences: what goes into them, what is held out, what is kept."""

import dataclasses
import shutil

import numpy as np
import pytest

from delo_jax.config import PreprocessConfig
from delo_jax.data import KittiTreeWriter
from delo_jax.errors import DatasetError
from delo_jax.preprocess import preprocess
from delo_jax.train import recorded
from delo_jax.train.recorded import count_recorded, recorded_worlds, split
from delo_jax.train.worlds import stored_config
from tests.oracles import street

CFG = PreprocessConfig(point_voxel_m=2.0, max_points=128, num_keypoints=32, keypoint_voxel_m=2.5)
LENGTHS = {"00": 33, "01": 20}  # 6 held out and 5 left between: training 0 to 22, and 0 to 9


def pose(index):
    return street.pose(0.5 * index - 8.0, 0.02 * index, yaw_deg=1.5 * index, roll_deg=0.1 * index)


def points(index):
    return street.scan(pose(index), num_rings=8, num_columns=180).points


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    for name, length in LENGTHS.items():
        with KittiTreeWriter(root, name) as writer:
            for index in range(length):
                writer.append(points(index), pose(index))
    return root


@pytest.fixture
def tree(written, tmp_path):
    """A tree that the test may damage."""
    return shutil.copytree(written, tmp_path / "kitti")


@pytest.fixture
def calls(monkeypatch):
    """Remembers the scans that are preprocessed."""
    seen = []

    def spy(points, cfg):
        seen.append(len(points))
        return preprocess(points, cfg)

    monkeypatch.setattr(recorded, "preprocess", spy)
    return seen


def bytes_of(world):
    return [array.tobytes() for array in (*world.scans, world.Ts_world_lidar)]


def test_worlds_hold_the_scans_and_poses_that_were_written(tree, tmp_path):
    """Oracle: the poses that were written, in the frame of the first, and the scans preprocessed by hand; features in half precision."""
    progress = []
    worlds = list(recorded_worlds(tree, ["00"], CFG, tmp_path / "store", validation=False, chunk=10, on_world=lambda: progress.append(1)))
    assert [len(world.Ts_world_lidar) for world in worlds] == [10, 12]  # a rest of 2 goes to the world before
    assert len(progress) == 2
    for world, start in zip(worlds, (0, 10), strict=True):
        assert world.Ts_world_lidar.dtype == np.float64
        for row, T in enumerate(world.Ts_world_lidar):
            np.testing.assert_allclose(T, np.linalg.inv(pose(0)) @ pose(start + row), atol=1e-9)
            for name, array in preprocess(points(start + row), CFG)._asdict().items():
                found = getattr(world.scans, name)[row]
                assert found.dtype == array.dtype
                np.testing.assert_allclose(found, array, **({"rtol": 1e-3, "atol": 1e-3} if name in ("normals", "features") else {}))


def test_raw_scans_are_stored_with_a_reserve(tree, tmp_path):
    """Oracle: `preprocess` of the stored configuration; more points than one input takes."""
    cfg = PreprocessConfig(sampling="raw", max_points=64, num_keypoints=64)
    (world,) = recorded_worlds(tree, ["01"], cfg, tmp_path / "store", validation=False)
    assert world.scans.mask.shape[1] > 64
    for row in range(9):
        for found, expected in zip(world.scans, preprocess(points(row), stored_config(cfg)), strict=True):
            np.testing.assert_array_equal(found[row], expected)


def test_validation_is_the_end_of_each_sequence(tree, tmp_path):
    """Oracle: counts by hand; the poses that were written."""
    worlds = list(recorded_worlds(tree, ["00", "01"], CFG, tmp_path / "store", validation=True))
    for world, length in zip(worlds, LENGTHS.values(), strict=True):
        expected = [np.linalg.inv(pose(0)) @ pose(index) for index in range(length - 6, length)]
        np.testing.assert_allclose(world.Ts_world_lidar, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("num_frames", "chunk", "training", "validation"),
    [
        (33, 100, [(0, 22)], [(27, 33)]),
        (33, 10, [(0, 10), (10, 22)], [(27, 33)]),
        (33, 8, [(0, 8), (8, 16), (16, 22)], [(27, 33)]),
        (17, 100, [(0, 6)], [(11, 17)]),
        (1101, 100, [*((k, k + 100) for k in range(0, 900, 100)), (900, 986)], [(991, 1091), (1091, 1101)]),
        (1201, 100, [*((k, k + 100) for k in range(0, 1000, 100)), (1000, 1076)], [(1081, 1181), (1181, 1201)]),
        (1051, 100, [*((k, k + 100) for k in range(0, 900, 100)), (900, 941)], [(946, 1051)]),
    ],
)
def test_split_by_hand(num_frames, chunk, training, validation):
    """Oracle: by hand; at most `chunk` scans, a rest of fewer than 6 goes to the range before."""
    assert split(num_frames, validation=False, chunk=chunk) == training
    assert split(num_frames, validation=True, chunk=chunk) == validation


@pytest.mark.parametrize("chunk", [6, 7, 10, 100])
def test_no_neighbour_of_a_validation_scan_is_trained_on(chunk):
    """Oracle: the rule itself, on every length: ranges without gaps or overlaps, 6 scans or more, 5 scans between the two sets."""
    for num_frames in range(17, 400):
        training, validation = (split(num_frames, validation=held_out, chunk=chunk) for held_out in (False, True))
        for ranges in (training, validation):
            assert all(stop == start for (_, stop), (start, _) in zip(ranges[:-1], ranges[1:], strict=True))
            assert all(6 <= stop - start <= chunk + 5 for start, stop in ranges)
        assert training[0][0] == 0
        assert validation[0][0] - training[-1][1] == 5
        assert validation[-1][1] == num_frames
        assert validation[-1][1] - validation[0][0] == max(6, num_frames // 10)


def test_count_is_that_of_the_worlds(tree, tmp_path, calls):
    """Oracle: by hand, without a scan being read."""
    assert count_recorded(tree, ["00", "01"], validation=False, chunk=10) == 3
    assert count_recorded(tree, ["00", "01"], validation=True) == 2
    assert count_recorded(tree, [], validation=False) == 0
    assert not calls


def test_second_call_reads_no_scan(tree, tmp_path, calls):
    """Oracle: the first call's bytes, when the scans are empty files by then."""
    first = list(recorded_worlds(tree, ["00", "01"], CFG, tmp_path / "store", validation=False, chunk=10))
    assert len(calls) == 22 + 9
    for path in tree.glob("sequences/*/velodyne/*.bin"):
        path.write_bytes(b"")
    again = list(recorded_worlds(tree, ["00", "01"], CFG, tmp_path / "store", validation=False, chunk=10))
    assert [bytes_of(world) for world in again] == [bytes_of(world) for world in first]
    assert len(calls) == 22 + 9


def test_interrupted_run_goes_on(tree, tmp_path, calls):
    """Oracle: the scans that are preprocessed; half a file does not count."""
    whole = list(recorded_worlds(tree, ["00", "01"], CFG, tmp_path / "store", validation=False, chunk=10))
    files = sorted((tmp_path / "store").iterdir())
    files[1].rename(files[1].with_suffix(".part"))
    calls.clear()
    again = list(recorded_worlds(tree, ["00", "01"], CFG, tmp_path / "store", validation=False, chunk=10))
    assert len(calls) == 12
    assert [bytes_of(world) for world in again] == [bytes_of(world) for world in whole]


def test_worlds_of_another_making_are_not_mixed_up(tree, tmp_path, calls):
    """Oracle: the scans that are preprocessed: all for another setting, tree, chunk, number of scans or elevation."""

    def num_made(root, *, name="01", cfg=CFG, chunk=10):
        calls.clear()
        list(recorded_worlds(root, [name], cfg, tmp_path / "store", validation=False, chunk=chunk))
        return len(calls)

    assert num_made(tree) == 9
    assert num_made(tree) == 0
    assert num_made(tree, cfg=dataclasses.replace(CFG, max_points=100)) == 9
    assert num_made(tree, chunk=9) == 0  # the same range
    assert num_made(shutil.copytree(tree, tmp_path / "copy")) == 9
    calib = tree / "sequences/01/calib.txt"
    calib.write_text(calib.read_text().replace("elevation_correction_deg: 0.0", "elevation_correction_deg: 0.205"))
    assert num_made(tree) == 9
    assert num_made(tree, name="00", chunk=10) == 22
    (tree / "sequences/00/velodyne/000000.bin").unlink()
    assert num_made(tree, name="00", chunk=10) == 21  # the first range is the same, its scans are not


def test_corrected_poses_reach_stored_worlds(tree, tmp_path, calls):
    """Oracle: the poses of the file, all moved along x of the camera by their number."""
    list(recorded_worlds(tree, ["01"], CFG, tmp_path / "store", validation=False))
    calls.clear()
    (tree / "poses/01.txt").write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(20)))
    (world,) = recorded_worlds(tree, ["01"], CFG, tmp_path / "store", validation=False)
    np.testing.assert_allclose(world.Ts_world_lidar[:, :3, 3], np.arange(9)[:, None] * [0, -1, 0], atol=1e-9)
    assert not calls


def test_what_cannot_be_trained_on_is_said_before_any_work(tree, tmp_path, calls):
    """Oracle: one sentence each, with what is there."""

    def make(names):
        return recorded_worlds(tree, names, CFG, tmp_path / "store", validation=False)

    with pytest.raises(DatasetError, match="expected a sequence '02', got 00, 01; name one of these"):
        next(make(["00", "02"]))
    with pytest.raises(DatasetError, match="expected a sequence '02', got 00, 01; name one of these"):
        count_recorded(tree, ["00", "02"], validation=False)
    (tree / "poses/01.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    with pytest.raises(DatasetError, match=r"expected poses of sequence '01', got none; .*3 rows for 20 scans; add poses/01.txt"):
        next(make(["00", "01"]))
    (tree / "poses/01.txt").unlink()
    with pytest.raises(DatasetError, match=r"expected poses of sequence '01', got none; add poses/01.txt and calib.txt, or leave it out"):
        next(make(["00", "01"]))
    for path in sorted((tree / "sequences/00/velodyne").iterdir())[16:]:
        path.unlink()
    with pytest.raises(DatasetError, match="expected at least 17 scans in sequence '00', got 16; leave it out"):
        next(make(["00"]))
    assert not calls


@pytest.mark.data
def test_real_sequence(data_dir, tmp_path):
    """Oracle: the rows of the poses file and Tr of calib.txt as the file holds them: inverse(Tr) inverse(P_a) P_b Tr."""
    calib = dict(line.split(":", 1) for line in (data_dir / "sequences/odo_00_056/calib.txt").read_text().splitlines() if ":" in line)
    rows = np.loadtxt(data_dir / "poses/odo_00_056.txt").reshape(-1, 3, 4)
    bottom = np.broadcast_to([[0.0, 0, 0, 1]], (len(rows), 1, 4))
    Ps, Tr = np.concatenate([rows, bottom], axis=1), np.vstack([np.reshape(calib["Tr"].split(), (3, 4)).astype(float), [0, 0, 0, 1]])
    for validation, start, length in ((False, 0, 20), (True, 78, 8)):
        world = next(recorded_worlds(data_dir, ["odo_00_056"], CFG, tmp_path, validation=validation, chunk=20))
        assert len(world.Ts_world_lidar) == length
        assert world.scans.mask.sum(axis=1).min() > 100
        Ts = world.Ts_world_lidar
        for k in range(length - 1):
            expected = np.linalg.inv(Tr) @ np.linalg.inv(Ps[start + k]) @ Ps[start + k + 1] @ Tr
            np.testing.assert_allclose(np.linalg.inv(Ts[k]) @ Ts[k + 1], expected, atol=1e-5)
