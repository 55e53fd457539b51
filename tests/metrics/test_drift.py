import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.metrics.drift import KITTI_LENGTHS_M, drift_by_speed, joined, kitti_drift, mean_drift, segment_errors


def straight(num_frames, step_m, *, yaw_step=0.0):
    """Poses at equal steps along x, the body turning in place by `yaw_step` rad a frame."""
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts[:, 0, 3] = step_m * np.arange(num_frames)
    Ts[:, :3, :3] = Rotation.from_euler("z", yaw_step * np.arange(num_frames)[:, None]).as_matrix()
    return Ts


def test_drift_of_a_wrong_scale_and_a_turning_body():
    """Oracle: closed form. Steps of 1 m: a segment of L spans L + 1 frames; 1 % of its length and all of its turn are wrong."""
    yaw_step = 1e-4
    drift = kitti_drift(straight(1001, 1.01, yaw_step=yaw_step), straight(1001, 1.0, yaw_step=0.0))
    lengths = np.array(KITTI_LENGTHS_M)
    counts = (1000 - (lengths + 1)) // 10 + 1
    turned = yaw_step * (lengths + 1)
    start_yaw = [yaw_step * np.arange(0, 10 * count, 10) for count in counts]
    # in the frame of E_i the estimate advances 1.01 (L + 1) along -yaw_i, the truth L + 1 along x
    t_rel = np.array(
        [
            np.mean((length + 1) * np.hypot(1.01 * np.cos(yaw) - 1.0, 1.01 * np.sin(yaw))) / length * 100
            for length, yaw in zip(lengths, start_yaw, strict=True)
        ]
    )
    np.testing.assert_array_equal(drift.num_segments_by_length, counts)
    np.testing.assert_allclose(drift.t_rel_percent_by_length, t_rel, rtol=1e-9)
    np.testing.assert_allclose(drift.r_rel_deg_per_100m_by_length, np.rad2deg(turned) / lengths * 100, rtol=1e-9)
    assert drift.num_segments == counts.sum()
    assert drift.t_rel_percent == pytest.approx(np.average(t_rel, weights=counts))


def test_segments_end_strictly_behind_their_length():
    """Oracle: by hand. On 1 m steps the first frame farther than 5 m is the sixth, so 7 poses hold one segment and 6 hold none."""
    drift = kitti_drift(straight(7, 1.5), straight(7, 1.0), lengths_m=(5.0, 6.0), step=1)
    np.testing.assert_array_equal(drift.num_segments_by_length, [1, 0])
    assert drift.t_rel_percent == pytest.approx(6 * 0.5 / 5 * 100)
    assert np.isnan(drift.t_rel_percent_by_length[1])
    with pytest.raises(DeloError, match=r"longer than the shortest segment of 5 m, got 5\.0 m in 6 poses"):
        kitti_drift(straight(6, 1.0), straight(6, 1.0), lengths_m=(5.0,))


@pytest.mark.parametrize("seed", range(2))
def test_drift_is_that_of_a_plain_loop(seed):
    """Oracle: the benchmark's definition written as loops, with numpy.linalg.inv and scipy's angle, on a winding track with stops."""
    rng = np.random.default_rng(seed)
    Ts_true, Ts_estimated = (winding_track(rng_track, 400) for rng_track in rng.spawn(2))
    lengths, step = (10.0, 25.0, 60.0), 3
    expected = [
        (np.linalg.norm(error[:3, 3]) / length, Rotation.from_matrix(error[:3, :3]).magnitude() / length)
        for error, length in loop_over_segments(Ts_estimated, Ts_true, lengths, step)
    ]
    drift = kitti_drift(Ts_estimated, Ts_true, lengths_m=lengths, step=step)
    assert drift.num_segments == len(expected)
    assert drift.t_rel_percent == pytest.approx(100 * np.mean(expected, axis=0)[0])
    assert drift.r_rel_deg_per_100m == pytest.approx(100 * np.rad2deg(np.mean(expected, axis=0)[1]))


def winding_track(rng, num_frames):
    Ts = [np.eye(4)]
    for _ in range(num_frames - 1):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix()
        motion[0, 3] = max(0.0, rng.normal(0.5, 0.5))  # stands still in one frame out of six
        Ts.append(Ts[-1] @ motion)
    return np.array(Ts)


def loop_over_segments(Ts_estimated, Ts_true, lengths, step, *, with_frames=False):
    distance = [0.0]
    for i in range(1, len(Ts_true)):
        distance.append(distance[-1] + float(np.linalg.norm(Ts_true[i, :3, 3] - Ts_true[i - 1, :3, 3])))
    for i in range(0, len(Ts_true), step):
        for length in lengths:
            j = next((j for j in range(i, len(Ts_true)) if distance[j] > distance[i] + length), None)
            if j is not None:
                motion_estimated, motion_true = np.linalg.inv(Ts_estimated[i]) @ Ts_estimated[j], np.linalg.inv(Ts_true[i]) @ Ts_true[j]
                error = np.linalg.inv(motion_estimated) @ motion_true
                yield (error, length, j - i + 1) if with_frames else (error, length)


def test_bad_input_is_one_clear_sentence():
    """Oracle: the messages' contract, expected and got."""
    Ts = straight(200, 1.0)
    with pytest.raises(DeloError, match=r"expected as many poses as Ts_true \(200\), got 199"):
        kitti_drift(Ts[:-1], Ts)
    with pytest.raises(DeloError, match=r"got 0\.0 m in 0 poses"):
        kitti_drift(Ts[:0], Ts[:0])
    with pytest.raises(DeloError, match="lengths_m: expected one or more lengths above 0"):
        kitti_drift(Ts, Ts, lengths_m=())
    with pytest.raises(DeloError, match="step: expected at least 1, got 0"):
        kitti_drift(Ts, Ts, step=0)


@pytest.mark.parametrize("seed", range(2))
def test_drift_by_speed_is_that_of_a_plain_loop(seed):
    """Oracle: the devkit's loop over classes of speed, whose length over time counts the frames at both ends, on a track with stops."""
    rng = np.random.default_rng(seed)
    Ts_true, Ts_estimated = (winding_track(rng_track, 400) for rng_track in rng.spawn(2))
    lengths, step = (10.0, 25.0), 3
    drift = drift_by_speed(segment_errors(Ts_estimated, Ts_true, lengths_m=lengths, step=step))
    np.testing.assert_array_equal(drift.speeds_mps, [2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24])
    classes: dict[int, list] = {speed: [] for speed in range(2, 25, 2)}
    for error, length, num_frames in loop_over_segments(Ts_estimated, Ts_true, lengths, step, with_frames=True):
        for speed, members in classes.items():
            if abs(length / (0.1 * num_frames) - speed) < 2.0:
                members.append((np.linalg.norm(error[:3, 3]) / length, Rotation.from_matrix(error[:3, :3]).magnitude() / length))
    assert sum(map(len, classes.values())) > 100
    np.testing.assert_array_equal(drift.num_segments, [len(members) for members in classes.values()])
    expected = [np.mean(members, axis=0) if members else [np.nan, np.nan] for members in classes.values()]
    np.testing.assert_allclose(np.column_stack([drift.t_rel_percent / 100, np.deg2rad(drift.r_rel_deg_per_100m) / 100]), expected)


def test_several_tracks_are_averaged_segment_by_segment():
    """Oracle: by hand. 7 and 9 poses at 1 m steps hold 1 and 3 segments of 5 m; errors of 50 % and 10 % of 6 m."""
    tracks = [
        segment_errors(straight(num, 1.0 + scale), straight(num, 1.0), lengths_m=(5.0,), step=1) for num, scale in ((7, 0.5), (9, 0.1))
    ]
    drift = mean_drift(joined(tracks))
    assert drift.num_segments == 4
    assert drift.t_rel_percent == pytest.approx(100 * (0.5 * 6 + 3 * 0.1 * 6) / 5 / 4)
    with pytest.raises(DeloError, match="sequences: expected one or more"):
        joined([])
    with pytest.raises(DeloError, match="the same segment lengths"):
        joined([tracks[0], segment_errors(straight(9, 1.0), straight(9, 1.0), lengths_m=(4.0,))])
