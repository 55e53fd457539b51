import json

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from delo_jax.metrics.ate import absolute_errors
from delo_jax.metrics.drift import drift_by_speed, joined, kitti_drift, mean_drift, segment_errors
from tests.metrics.released import METHODS, SEQUENCES, released, truth

THIRD_DECIMAL = 5e-4
# of SiMpLE in its real-time setting, camera frame, 00 to 10; rotations from its unrounded text
SIMPLE_T = [0.667, 0.775, 0.626, 0.737, 0.407, 0.337, 0.261, 0.471, 0.824, 0.568, 0.645]
SIMPLE_R = [0.3447, 0.1128, 0.2053, 0.1399, 0.1635, 0.2803, 0.0987, 0.4444, 0.2210, 0.1783, 0.3556]
SIMPLE_SEGMENTS = [3283, 676, 3453, 184, 43, 1806, 570, 317, 2813, 958, 464]
# LiDAR frame, rows paired by index: rotation, translation
DELO = {"07": (1.44, 1.97), "08": (3.48, 9.02), "09": (1.54, 4.26), "10": (2.16, 3.54)}
DELO_PUEPE = {"03": (1.10, 1.60), "07": (0.41, 0.74), "08": (0.64, 1.36), "09": (0.57, 1.23), "10": (0.90, 1.96)}


def arc(num_frames, step_m, bend_per_m):
    """Poses at equal steps along a circle in the plane, x of the body along the way."""
    s = step_m * np.arange(num_frames)
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", (bend_per_m * s)[:, None]).as_matrix()
    Ts[:, 0, 3], Ts[:, 1, 3] = np.sin(bend_per_m * s) / bend_per_m, (1 - np.cos(bend_per_m * s)) / bend_per_m
    return Ts


def test_an_arc_in_place_of_a_straight_line():
    """Oracle: closed form. 1 m steps: a segment of L spans L + 1 m and L + 2 frames, and every one errs alike, from any start."""
    bend = 2e-4  # 1.15 deg in 100 m
    true = np.tile(np.eye(4), (1201, 1, 1))
    true[:, 0, 3] = np.arange(1201)
    lengths = np.arange(100.0, 801.0, 100.0)
    s, counts = lengths + 1, (1200 - (lengths + 1)) // 10 + 1
    t_rel = 100 * np.hypot(np.sin(bend * s) / bend - s, (1 - np.cos(bend * s)) / bend) / lengths
    r_rel = 100 * np.rad2deg(bend * s) / lengths
    segments = segment_errors(arc(1201, 1.0, bend), true)
    drift, by_speed = mean_drift(segments), drift_by_speed(segments)
    np.testing.assert_allclose(drift.t_rel_percent_by_length, t_rel, atol=1e-6)
    np.testing.assert_allclose(drift.r_rel_deg_per_100m_by_length, r_rel, atol=1e-6)
    assert drift.t_rel_percent == pytest.approx(np.average(t_rel, weights=counts), abs=1e-6)
    assert drift.r_rel_deg_per_100m == pytest.approx(np.average(r_rel, weights=counts), abs=1e-6)
    assert f"{drift.t_rel_percent:.3f} {drift.r_rel_deg_per_100m:.3f}" == "3.819 1.151"  # the sum over all starts, worked out apart
    # 100 m in 10.2 s to 800 m in 80.2 s: 9.80 to 9.98 m/s, within 2 m/s of 8 and of 10
    np.testing.assert_array_equal(np.flatnonzero(by_speed.num_segments), [3, 4])
    np.testing.assert_allclose(by_speed.t_rel_percent[[3, 4]], drift.t_rel_percent, rtol=1e-12)


@pytest.fixture(scope="module")
def made():
    """A long drive made here, hills, bends and stops in it, and an estimate that drifts off it."""
    rng = np.random.default_rng(0)
    num = 3000
    speed = np.clip(8 + 6 * np.sin(np.arange(num) / 90), 0, None) * 0.1
    rates = np.column_stack([0.001 * np.sin(np.arange(num) / 40), 0.002 * np.cos(np.arange(num) / 70), 0.02 * np.sin(np.arange(num) / 150)])
    return chained(speed, rates), chained(1.003 * speed, rates + 2e-4 * rng.normal(size=(num, 3)))


def chained(steps_m, rates_rad):
    Ts = [np.eye(4)]
    for step, rate in zip(steps_m[:-1], rates_rad[:-1], strict=True):
        motion = np.eye(4)
        motion[:3, :3], motion[0, 3] = Rotation.from_rotvec(rate).as_matrix(), step
        Ts.append(Ts[-1] @ motion)
    return np.array(Ts)


def kiss_icp_drift(Ts_estimated, Ts_true):
    """Percent, and degrees per 100 m as it would give them with all digits of pi."""
    kiss = pytest.importorskip("kiss_icp.metrics")
    t_rel, r_rel_deg_per_m = kiss.sequence_error(list(Ts_true), list(Ts_estimated))
    return t_rel, 100 * r_rel_deg_per_m * 3.14 / np.pi


def test_a_made_drive_as_the_peers_see_it(made):
    """Oracle: KISS-ICP's port of the devkit, whose pi is 3.14 (1.0005 times the rotation) and which computes in float32; evo's APE."""
    Ts_true, Ts_estimated = made
    reference, path = PosePath3D(poses_se3=list(Ts_true)), PosePath3D(poses_se3=list(Ts_estimated))
    path.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    assert absolute_errors(Ts_estimated, Ts_true).rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    drift = kitti_drift(Ts_estimated, Ts_true)
    t_rel, r_rel = kiss_icp_drift(Ts_estimated, Ts_true)
    assert drift.t_rel_percent == pytest.approx(t_rel, abs=THIRD_DECIMAL)
    assert drift.r_rel_deg_per_100m == pytest.approx(r_rel, abs=THIRD_DECIMAL)


@pytest.mark.data
def test_simple_in_the_camera_frame(data_dir):
    """Oracle: the numbers above, of another evaluator, to three decimals, and the number of segments."""
    for sequence, t_rel, r_rel, count in zip(SEQUENCES, SIMPLE_T, SIMPLE_R, SIMPLE_SEGMENTS, strict=True):
        drift = kitti_drift(released(data_dir, "simple_online", sequence), truth(data_dir, sequence, "camera"))
        assert drift.num_segments == count
        assert drift.t_rel_percent == pytest.approx(t_rel, abs=THIRD_DECIMAL)
        assert drift.r_rel_deg_per_100m == pytest.approx(r_rel, abs=THIRD_DECIMAL)


@pytest.mark.data
@pytest.mark.parametrize(("method", "known"), [("delo", DELO), ("delo_puepe", DELO_PUEPE)])
def test_the_papers_own_trajectories_in_the_lidar_frame(method, known, data_dir):
    """Oracle: the two decimals above, of another evaluator; where the paper prints others, they are not what was released."""
    for sequence, (r_rel, t_rel) in known.items():
        Ts = released(data_dir, method, sequence)
        drift = kitti_drift(Ts, truth(data_dir, sequence, "lidar")[: len(Ts)])
        assert (round(drift.r_rel_deg_per_100m, 2), round(drift.t_rel_percent, 2)) == (r_rel, t_rel)


@pytest.mark.data
@pytest.mark.parametrize("method", METHODS)
def test_all_released_trajectories_in_both_frames(method, data_dir):
    """Oracle: golden_metrics.json, computed by another evaluator; 5e-4 covers its trace angle and the float32 rows."""
    golden = json.loads((data_dir / "released_trajectories" / "golden_metrics.json").read_text())["methods"][method]
    calibrations = np.load(data_dir / "kitti_calib_tr.npz")
    for sequence in SEQUENCES:
        Ts = released(data_dir, method, sequence)
        T_cam_lidar = np.vstack([calibrations[sequence], [0, 0, 0, 1]])
        own = "camera" if method == "simple_online" else "velodyne"
        for frame in ("camera", "velodyne"):
            if frame not in golden[sequence]:
                continue
            to_frame = np.eye(4) if frame == own else T_cam_lidar if frame == "camera" else np.linalg.inv(T_cam_lidar)
            Ts_true = truth(data_dir, sequence, "camera" if frame == "camera" else "lidar")[: len(Ts)]
            drift = kitti_drift(to_frame @ Ts @ np.linalg.inv(to_frame), Ts_true)
            expected = golden[sequence][frame]
            assert drift.num_segments == expected["n"]
            assert drift.t_rel_percent == pytest.approx(expected["t_rel"], abs=THIRD_DECIMAL)
            assert drift.r_rel_deg_per_100m == pytest.approx(expected["r_rel"], abs=THIRD_DECIMAL)


@pytest.mark.data
def test_released_trajectories_as_kiss_icp_sees_them(data_dir):
    """Oracle: KISS-ICP's port of the devkit, whose pi is 3.14 and which computes in float32."""
    for sequence in ("03", "06", "07"):
        Ts, Ts_true = released(data_dir, "simple_online", sequence), truth(data_dir, sequence, "camera")
        drift = kitti_drift(Ts, Ts_true)
        t_rel, r_rel = kiss_icp_drift(Ts, Ts_true)
        assert drift.t_rel_percent == pytest.approx(t_rel, abs=THIRD_DECIMAL)
        assert drift.r_rel_deg_per_100m == pytest.approx(r_rel, abs=THIRD_DECIMAL)


@pytest.mark.data
def test_the_benchmarks_overall_number(data_dir):
    """Oracle: mean of the numbers per sequence, weighted by their segments, all of the lists above."""
    segments = [
        segment_errors(released(data_dir, "simple_online", sequence), truth(data_dir, sequence, "camera")) for sequence in SEQUENCES
    ]
    drift = mean_drift(joined(segments))
    assert drift.num_segments == sum(SIMPLE_SEGMENTS)
    assert drift.t_rel_percent == pytest.approx(np.average(SIMPLE_T, weights=SIMPLE_SEGMENTS), abs=THIRD_DECIMAL)
    assert drift.r_rel_deg_per_100m == pytest.approx(np.average(SIMPLE_R, weights=SIMPLE_SEGMENTS), abs=THIRD_DECIMAL)
