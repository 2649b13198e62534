import json

import numpy as np
import pytest
from PIL import Image
from support.corner import FOCAL, HEIGHT, WIDTH, write_corner
from support.running import said


@pytest.fixture
def corner(tmp_path):
    """Write the corner as a transforms.json after `change` of its (count, 4, 4) poses."""

    def write(change=lambda poses: poses):
        folder = tmp_path / "corner"
        poses = np.tile(np.eye(4), (10, 1, 1))
        poses[:, :3] = write_corner(folder / "images", 10)
        frames = [
            {"file_path": f"images/view {number}.png", "transform_matrix": pose.tolist()}
            for number, pose in enumerate(change(poses))
        ]
        content = {"fl_x": FOCAL, "fl_y": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content))
        return folder

    return write


@pytest.fixture
def doctor(nerf, tmp_path):
    """Call `nerf doctor` on a transforms.json; return what it printed and its checks by name."""

    def call(folder, *arguments):
        out = tmp_path / "examined"
        settings = (f"scene.root={folder}", f"scene.cache_dir={tmp_path / 'cache'}", f"paths.output_dir={out}")
        result = nerf("doctor", "scene=transforms", *settings, *arguments)
        written = json.loads((out / "doctor.json").read_text()) if result.code == 0 else {"checks": []}
        return result, {check["name"]: check for check in written["checks"]}

    return call


def test_a_good_capture(corner, doctor, tmp_path):
    result, checks = doctor(corner())
    assert result.code == 0
    assert len(checks) > 20
    assert all(set(check) == {"name", "verdict", "message", "cure"} for check in checks.values())
    assert {check["verdict"] for check in checks.values()} <= {"ok", "look", "not judged"}
    assert all((check["cure"] == "") == (check["verdict"] == "ok") for check in checks.values())
    assert json.loads((tmp_path / "examined" / "doctor.json").read_text())["scene"] == "transforms"
    with Image.open(tmp_path / "examined" / "doctor.png") as picture:
        assert picture.size == (1500, 1150)
    assert not (tmp_path / "examined" / "doctor_proof.png").exists()
    lines = result.out.splitlines()
    about = f"{tmp_path / 'corner'}: scene=transforms, 10 photographs of {WIDTH} x {HEIGHT} ("
    assert f"capture {about}" in " ".join(result.out.split())
    assert json.loads((tmp_path / "examined" / "doctor.json").read_text())["capture"].startswith(about)
    assert sum(line.startswith(("ok ", "look ", "wrong ", "not judged ")) for line in lines) == len(checks)
    assert "0 wrong; 10 views examined in" in result.out


def test_json_is_all_that_is_printed(corner, doctor):
    result, checks = doctor(corner(), "--json")
    printed = json.loads(result.out)
    assert {check["name"]: check for check in printed["checks"]} == checks
    assert [path.rpartition("/")[2] for path in printed["written"]] == ["doctor.json", "doctor.png"]


def test_opencv_axes_are_printed_with_their_cure_in_the_width_of_the_terminal(corner, doctor, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    result, checks = doctor(corner(lambda poses: poses * [1.0, -1.0, -1.0, 1.0]))
    # What a person can check: the details, and the lines that they should lie on.
    assert "doctor_proof.png" in result.out
    with Image.open(tmp_path / "examined" / "doctor_proof.png") as picture:
        assert picture.size[0] == 1440
    assert result.code == 0
    assert checks["axes"]["verdict"] == "wrong"
    assert "OpenCV" in checks["axes"]["message"]
    assert "cure: Set scene.axes=opencv, or negate the second and third column of every rotation." in " ".join(
        result.out.split()
    )
    assert [line for line in result.out.splitlines() if len(line) > 80 and not line.startswith("written")] == []
    assert "wrong; 10 views examined" in result.out


def test_a_capture_that_cannot_be_read_ends_with_one_paragraph(doctor, tmp_path):
    said(doctor(tmp_path / "nowhere")[0], "does not exist")
    assert not (tmp_path / "examined").exists()
