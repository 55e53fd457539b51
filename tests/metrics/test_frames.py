import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.metrics.frames import compare_frames, sensor_of
from tests.metrics.released import METHODS, SEQUENCES, released, truth

T_CAM_LIDAR = np.array([[0.0, -1, 0, 0.3], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])


def drive(num_frames=200, *, speed_mps=8.0, turn_deg=1.5, back=False, seed=None):
    """LiDAR poses of a vehicle that drives a bend, x of its body ahead; with a seed, noise of 10 cm and 0.2 deg on every pose."""
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    yaw = np.deg2rad(turn_deg) * np.arange(num_frames)
    Ts[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    step = (-0.1 if back else 0.1) * speed_mps * np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
    Ts[1:, :3, 3] = np.cumsum(step[:-1], axis=0)
    return Ts if seed is None else Ts @ noise(num_frames, seed, 0.1, np.deg2rad(0.2))


def noise(num, seed, translation_m, rotation_rad):
    rng = np.random.default_rng(seed)
    Ts = np.tile(np.eye(4), (num, 1, 1))
    Ts[:, :3, :3] = Rotation.from_rotvec(rotation_rad * rng.normal(size=(num, 3))).as_matrix()
    Ts[:, :3, 3] = translation_m * rng.normal(size=(num, 3))
    return Ts


def in_camera(Ts):
    return T_CAM_LIDAR @ Ts @ np.linalg.inv(T_CAM_LIDAR)


@pytest.mark.parametrize("back", [False, True], ids=["forward", "reversing"])
def test_camera_and_lidar_are_told_apart(back):
    """Oracle: by construction: the vehicle moves along x of the LiDAR, which is z of the camera."""
    Ts_estimated, Ts_true = drive(back=back, seed=0), drive(back=back)
    sign = "-" if back else "+"
    for estimated, true, axes in (
        (Ts_estimated, Ts_true, "xx"),
        (in_camera(Ts_estimated), in_camera(Ts_true), "zz"),
        (in_camera(Ts_estimated), Ts_true, "zx"),
        (Ts_estimated, in_camera(Ts_true), "xz"),
    ):
        found = compare_frames(estimated, true)
        assert (found.estimated_axis, found.true_axis) == (sign + axes[0], sign + axes[1])
        assert found.agree == (axes[0] == axes[1])
        assert not found.opposite
        assert found.angle_deg == pytest.approx(0.0 if found.agree else 90.0, abs=5.0)
    assert [sensor_of(axis) for axis in ("+x", "-x", "+z", "+y", "")] == ["lidar", "lidar", "camera", "", ""]


@pytest.mark.parametrize("seed", range(3))
def test_what_fits_is_not_refused(seed):
    """Oracle: one sensor frame by construction: other world frames, stops, a park-in, standing, wrong scale, a mounting 5 deg off."""
    Ts_true, Ts_estimated = drive(), drive(seed=seed)
    T_world = noise(1, seed, 100.0, 1.0)
    stops = np.repeat(np.arange(200), np.where(np.arange(200) % 20 == 0, 8, 1))
    there_and_back = np.concatenate([np.arange(200), np.arange(200)[::-1]])
    slow = drive(speed_mps=3.0)
    slow[:, :3, 3] *= 1.8
    tilted = noise(1, seed, 0.3, 0.05)
    pairs = {
        "world frames": (T_world @ Ts_estimated, Ts_true),
        "stops": (Ts_estimated[stops] @ noise(len(stops), seed, 0.02, 0.001), Ts_true[stops]),
        "there and back": (Ts_estimated[there_and_back], Ts_true[there_and_back]),
        "standing": (noise(200, seed, 0.02, 0.002), np.tile(np.eye(4), (200, 1, 1))),
        "wrong scale": (slow, drive(speed_mps=3.0)),
        "mounting": (Ts_estimated @ tilted, Ts_true),
        "two poses": (Ts_estimated[:2], Ts_true[:2]),
    }
    assert [name for name, pair in pairs.items() if not compare_frames(*pair).agree] == []
    assert compare_frames(*pairs["standing"]).estimated_axis == ""
    assert np.isnan(compare_frames(*pairs["two poses"]).angle_deg)


@pytest.mark.parametrize("seed", range(3))
def test_a_bad_estimate_is_bad_not_of_another_frame(seed):
    """Oracle: an estimate that moves anywhere, about 90 deg from the truth; one that stands; one that goes backward."""
    rng = np.random.default_rng(seed)
    Ts_true = drive()
    lost = np.tile(np.eye(4), (200, 1, 1))
    lost[:, :3, :3] = Rotation.random(200, rng=rng).as_matrix()
    lost[:, :3, 3] = np.cumsum(rng.normal(size=(200, 3)), axis=0)
    for estimated in (lost, np.tile(np.eye(4), (200, 1, 1))):
        assert compare_frames(estimated, Ts_true).agree
    backward = compare_frames(drive(back=True), Ts_true)
    assert backward.agree
    assert backward.opposite


def test_bad_input_is_one_clear_sentence():
    """Oracle: the messages' contract, expected and got."""
    Ts = drive()
    with pytest.raises(DeloError, match=r"expected as many poses as Ts_true \(200\), got 199"):
        compare_frames(Ts[:-1], Ts)


@pytest.mark.data
@pytest.mark.parametrize("method", METHODS)
def test_released_trajectories_are_in_the_frame_that_they_say(method, data_dir):
    """Oracle: the frames that the files are documented in, against the official poses in the camera's and in the LiDAR's frame."""
    own, other = ("camera", "lidar") if method == "simple_online" else ("lidar", "camera")
    for sequence in SEQUENCES:
        Ts = released(data_dir, method, sequence)
        fitting = compare_frames(Ts, truth(data_dir, sequence, own)[: len(Ts)])
        assert fitting.agree
        assert fitting.angle_deg < 3.0
        assert sensor_of(fitting.estimated_axis) == sensor_of(fitting.true_axis) == own
        mixed_up = compare_frames(Ts, truth(data_dir, sequence, other)[: len(Ts)])
        assert not mixed_up.agree
        assert sensor_of(mixed_up.true_axis) == other
