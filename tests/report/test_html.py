import base64
import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.report import html
from delo_jax.report.cloud import PlacedCloud
from delo_jax.report.html import Card, Report, render
from delo_jax.report.page_data import Frames, Refined
from tests.report.pages import Page

HOSTILE = '</script><script>alert("1")</script><!-- & {{data}}'


def frames_of(num, *, unknown=False, reason=""):
    """A bend to the left that climbs, one frame in seven of low confidence."""
    steps = np.arange(num)
    Ts = np.tile(np.eye(4), (num, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", 0.01 * steps[:, None]).as_matrix()
    Ts[:, :3, 3] = np.stack([1.1 * steps, 0.005 * steps**2, 0.02 * steps], axis=1)
    covariances = np.diag(np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03]) ** 2) * steps[:, None, None]
    return Frames(
        stamps_ns=1_316_000_000_123_456_789 + 103_500_000 * steps,
        statuses=["low_confidence" if i % 7 == 3 else "ok" for i in steps],
        reasons=[reason if i % 7 == 3 else "" for i in steps],
        confidences=np.full(num, np.nan if unknown else 0.9),
        since=np.maximum(steps - 1, 0),
        Ts_world_lidar=Ts,
        motion_covariances=covariances * (np.nan if unknown else 0.5),
        pose_covariances=covariances * (np.nan if unknown else 1.0),
        timing_s={"prepare": np.full(num, 0.01), "solve": np.where(steps % 5 == 0, np.nan, 0.02)},
    )


def cloud_of(num):
    rng = np.random.default_rng(0)
    points = rng.uniform([-50.0, -30.0, -2.0], [120.0, 30.0, 6.0], size=(num, 3))
    return PlacedCloud(points, points[:, 2] - 1.0)


def report_of(frames, **changes):
    parts = {
        "title": "drive",
        "subtitle": "by hand",
        "verdict": "good",
        "cards": [Card("Path", "12", "m", "note")],
        "notes": [],
        "frames": frames,
        "cloud": cloud_of(500),
        "truth": None,
        "refined": None,
        "making": [("data", "by hand")],
        "config": "[run]",
    }
    return Report(**(parts | changes))


def test_the_numbers_of_the_page_are_those_given():
    """Oracle: the input, by SciPy's rotations and by hand; millimetres and four digits are kept."""
    frames = frames_of(40)
    truth = frames.Ts_world_lidar.copy()
    truth[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec([0.0, 0.0, 0.02]).as_matrix().T  # every pose is turned by 0.02 rad
    refined = Refined(truth + 0.0, 0.25 * frames.pose_covariances)
    data = Page(render(report_of(frames, truth=truth, refined=refined))).data
    Ts = frames.Ts_world_lidar
    assert data["n"] == 40
    assert data["stamp_ns"] == "1316000000123456789"
    np.testing.assert_allclose(data["t"], 0.1035 * np.arange(40), atol=1e-6)
    for name, poses in (("track", Ts), ("truth", truth), ("refined", truth)):
        np.testing.assert_allclose(data[name], poses[:, :3, 3].T, atol=5.1e-4)
    assert [data["statuses"][i] for i in data["status"]] == frames.statuses
    np.testing.assert_allclose(data["yaw"], 0.01 * np.arange(40), atol=1e-4)
    pose, after, motion = data["sigmas"]
    degrees = np.rad2deg([1e-3, 2e-3, 3e-3])[:, None] * np.sqrt(np.arange(40))
    np.testing.assert_allclose(pose["sigma"][:3], degrees, rtol=1e-3)
    np.testing.assert_allclose(after["sigma"][:3], 0.5 * degrees, rtol=1e-3)
    np.testing.assert_allclose(motion["sigma"][5], 0.03 * np.sqrt(0.5 * np.arange(40)), rtol=1e-3)
    np.testing.assert_allclose(pose["error"], np.repeat([0, 0, np.rad2deg(0.02), 0, 0, 0], 40).reshape(6, 40), atol=1e-3)
    np.testing.assert_allclose(after["error"], 0.0, atol=1e-12)
    xx, xy, yy = (np.array(values) for values in data["ellipse"])
    yaw, counts = 0.01 * np.arange(40), np.arange(40)
    np.testing.assert_allclose(xx, counts * ((0.01 * np.cos(yaw)) ** 2 + (0.02 * np.sin(yaw)) ** 2), rtol=1e-3)
    np.testing.assert_allclose(xy, counts * (0.01**2 - 0.02**2) * np.sin(yaw) * np.cos(yaw), rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(xx + yy, counts * (0.01**2 + 0.02**2), rtol=1e-3)
    speed = np.hypot(np.hypot(1.1, 0.02), 0.005 * (2 * counts[1:] - 1)) / 0.1035
    assert data["speed"][0] is None
    np.testing.assert_allclose(data["speed"][1:], speed, rtol=1e-3)
    assert data["timing"]["prepare"] == [10.0] * 40
    assert data["timing"]["solve"][:2] == [None, 20.0]


def test_the_points_of_the_map_are_those_given():
    """Oracle: the cloud, in the order of its heights; int16 is decoded by hand, to half a step."""
    cloud = cloud_of(3000)
    stored = Page(render(report_of(frames_of(3), cloud=cloud))).data["cloud"]
    numbers = np.frombuffer(base64.b64decode(stored["points"]), "<i2").reshape(-1, 3)
    found = numbers * np.array(stored["step"]) + stored["middle"]
    order = np.argsort(cloud.heights)
    assert stored["count"] == 3000
    np.testing.assert_allclose(found, cloud.points[order], atol=0.5 * max(stored["step"]) + 1e-4)
    levels = np.frombuffer(base64.b64decode(stored["levels"]), np.uint8)
    low, high = stored["heights"]
    np.testing.assert_allclose(levels / 255, np.clip((cloud.heights[order] - low) / (high - low), 0, 1), atol=0.01)


@pytest.mark.parametrize("unknown", [False, True], ids=["covariances", "no covariances"])
@pytest.mark.parametrize("num", [1, 2, 9])
def test_short_runs_and_methods_without_uncertainty(num, unknown):
    """Oracle: JSON without NaN, read strictly; what is unknown is null, and there is no truth, refined track or map."""
    frames = frames_of(num, unknown=unknown)
    data = Page(render(report_of(frames, cloud=PlacedCloud(np.zeros((0, 3)), np.zeros(0))))).data
    assert (data["truth"], data["refined"], data["cloud"]["count"], data["cloud"]["points"]) == (None, None, 0, "")
    assert [one["error"] for one in data["sigmas"]] == [None, None]
    sigmas = [value for one in data["sigmas"] for row in one["sigma"] for value in row]
    assert len(sigmas) == 12 * num
    assert {value is None for value in sigmas + data["confidence"]} == {unknown}


def test_nothing_is_loaded_from_elsewhere():
    """Oracle: every attribute that can load something, and every address, in the whole text."""
    text = render(report_of(frames_of(9)))
    page = Page(text)
    assert set(page.resources) == {"#map"}
    for word in ("http:", "https:", "url(", "@import", "fetch(", "XMLHttp", "import("):
        assert word not in text


def test_hostile_names_stay_text():
    """Oracle: the parser finds as many scripts as the template has, and the names as words."""
    changes = {name: HOSTILE for name in ("title", "subtitle", "verdict", "config")}
    lists = {"notes": [HOSTILE], "cards": [Card(*4 * [HOSTILE])], "making": [(HOSTILE, HOSTILE)]}
    text = render(report_of(frames_of(9, reason=HOSTILE), **changes, **lists))
    plain = render(report_of(frames_of(9)))
    assert text.count("<script") == plain.count("<script") == 2
    page = Page(text)
    assert page.data["reason"] == {"3": HOSTILE}
    assert sum(HOSTILE in word for word in page.words) >= 9


def test_the_table_names_what_is_not_ok():
    """Oracle: frames 3 and 10 by hand, with their reason and a link each; a run without any says so."""
    text = render(report_of(frames_of(14, reason="few points")))
    assert 'data-frame="3">3</a><td>0.31<td>' in text
    assert 'data-frame="10">10</a>' in text
    assert text.count("<td>few points") == 2
    assert "every frame is ok" in render(report_of(frames_of(3)))
    assert "and 86 more" in render(report_of(frames_of(2000)))  # 286 of them, 200 are shown


def test_a_long_drive_is_a_small_file():
    """Oracle: bytes: 4,500 frames with truth and a refined track and 60,000 points stay below 4 MB."""
    frames = frames_of(4500)
    refined = Refined(frames.Ts_world_lidar, frames.pose_covariances)
    text = render(report_of(frames, cloud=cloud_of(60_000), truth=frames.Ts_world_lidar, refined=refined))
    assert len(text.encode()) < 4e6


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node to read the script")
def test_the_script_is_javascript(tmp_path):
    """Oracle: node's parser."""
    script = tmp_path / "page.js"
    script.write_text("(() => {" + "".join((html.TEMPLATES / f"page_{part}.js").read_text() for part in ("map", "charts")) + "})();")
    checked = subprocess.run(["node", "--check", str(script)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
