import csv
import json

import numpy as np
import pytest

from delo_jax.data.fields import RawScan
from delo_jax.data.sequence import Dataset


def floats(points) -> bytes:
    """Bytes of a .bin file."""
    return np.asarray(points, "<f4").tobytes()


def pcd(points, announced: int | None = None) -> bytes:
    """A binary .pcd file that announces a number of points."""
    count = len(points) if announced is None else announced
    header = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary\n"
    return header.encode() + floats(points)


ROOM = np.random.default_rng(0).uniform(-20.0, 20.0, (5000, 4))
BAD = {
    "empty": b"",
    "truncated": floats(ROOM)[:-6],
    "one_point": floats(ROOM[:1]),
    "ten_points": floats(ROOM[:10]),
    "all_equal": floats(np.tile([10.0, 1.0, 0.0, 0.0], (5000, 1))),
    "all_nan": floats(np.full((5000, 4), np.nan)),
    "all_infinite": floats(np.full((5000, 4), np.inf)),
    "seven_columns": floats(np.random.default_rng(0).uniform(-20.0, 20.0, (1001, 7))),
    "no_coordinates": floats(np.full((5000, 4), 1e30)),
}


def write(path, content):
    """Bytes into a file; None becomes a file that cannot be opened, whoever asks."""
    path.symlink_to(path.parent / "nowhere") if content is None else path.write_bytes(content)


@pytest.mark.parametrize("name", [*BAD, "unreadable"])
def test_a_folder_of_one_bad_scan(name, cli, tmp_path):
    """Oracle: exit code 1, and one sentence on stderr that names the file and what to do."""
    path = tmp_path / f"{name}.bin"
    write(path, BAD.get(name))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.code == 1
    sentence = done.err.strip().splitlines()[-1]
    assert sentence.startswith("delo: ")
    assert str(path) in sentence
    assert "check that" in sentence


def test_bad_scans_among_good_ones(scans, cli, tmp_path):
    """Oracle: the order in which the files were laid out: every bad one is a rejected frame, every good one is ok."""
    folder, contents = tmp_path / "scans", []
    folder.mkdir()
    for name in [*BAD, "unreadable"]:
        contents += [scans[0].read_bytes(), BAD.get(name)]
    contents.append(scans[0].read_bytes())
    for index, content in enumerate(contents):
        write(folder / f"{index:06d}.bin", content)
    done = cli("run", folder, "--out", tmp_path / "out")
    assert done.code == 0
    with (tmp_path / "out" / "frames.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    assert [frame["status"] for frame in frames] == ["ok", "rejected"] * (len(BAD) + 1) + ["ok"]
    assert all(frame["reason"] for frame in frames[1::2])
    assert all(float(frame["sigma_x_m"]) >= 1.0 for frame in frames[1::2])  # honest: nobody has measured
    assert done.out.count("rejected: ") == 5 + 1
    assert "more; frames.csv has them all" in done.out
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames"] == {"ok": len(BAD) + 2, "rejected": len(BAD) + 1}


def test_times_that_are_none_among_good_ones(scans, cli, tmp_path, monkeypatch):
    """Oracle: the order of the scans; times of the day instead of the sweep are a rejected frame, not the end of the drive."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for index in range(3):
        write(folder / f"{index:06d}.bin", scans[0].read_bytes())
    read = Dataset.__getitem__

    def read_at_noon(self, index):
        scan = read(self, index)
        return RawScan(scan.points, np.full(len(scan.points), 43_200.0)) if index == 1 else scan

    monkeypatch.setattr(Dataset, "__getitem__", read_at_noon)
    done = cli("run", folder, "--out", tmp_path / "out", "--deskew", "auto")
    assert done.code == 0
    with (tmp_path / "out" / "frames.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    assert [frame["status"] for frame in frames] == ["ok", "rejected", "ok"]
    assert [frame["since_index"] for frame in frames] == ["0", "0", "0"]
    assert frames[1]["reason"] == "times_s: expected seconds relative to the stamp, within 1 s, got 43200 s"


def test_a_pcd_that_lies_about_its_size(scans, cli, tmp_path):
    """Oracle: the number of points that were written."""
    points = np.fromfile(scans[0], "<f4").reshape(-1, 4)[:, :3]
    for index, announced in enumerate((None, 10**9, None)):
        (tmp_path / f"{index}.pcd").write_bytes(pcd(points, announced))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.code == 0
    assert f"rejected: {tmp_path / '1.pcd'}: " in done.out
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames"] == {"ok": 2, "rejected": 1}


@pytest.mark.parametrize(
    ("name", "make"), [("empty", lambda path: path.mkdir()), ("file.bin", lambda path: path.write_bytes(floats(ROOM)))]
)
def test_no_folder_of_scans(name, make, cli, tmp_path):
    """Oracle: exit code 2 and one sentence that names the path."""
    make(tmp_path / name)
    done = cli("run", tmp_path / name, "--out", tmp_path / "out")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"delo: {tmp_path / name}: expected ")
    assert not (tmp_path / "out").exists()
