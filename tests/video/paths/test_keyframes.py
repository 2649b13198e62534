"""Keyframe files and the curves through them."""

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene
from test_chosen_paths import MIDDLE, UP, frame, keyframe_file

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import project
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes, write_keyframes
from nerf_lightning.video.paths.spline import rotations_along


def test_what_is_written_is_read_back_and_a_file_by_hand_may_be_a_bare_list_of_whole_numbers(tmp_path):
    keyframes = [
        Keyframe((1.0, 2.0, 3.0), look_at=(0.0, 0.0, 0.5), up=(0.0, 1.0, 0.0), fov=40.0, time=0.0),
        Keyframe((1e-7, 2.0, 3.25), look_at=(0.0, -1.0, 0.0), time=1.5),
    ]
    write_keyframes(tmp_path / "keys.yaml", keyframes)
    assert read_keyframes(tmp_path / "keys.yaml") == keyframes
    assert [file.name for file in tmp_path.iterdir()] == ["keys.yaml"]
    (tmp_path / "keys.yaml").write_text(
        "- {position: [1, 0, 0], look_at: [0, 0, 0]}\n- {position: [0, 1, 0], look_at: [0, 0, 0]}"
    )
    first, second = read_keyframes(tmp_path / "keys.yaml")
    assert (first.position, first.ahead, second.ahead) == ((1, 0, 0), (-1, 0, 0), (0, -1, 0))


PLACES = ((5.0, 2.0, 4.0), (1.0, 7.0, 5.0), (-4.0, 2.0, 3.0))
GOOD = "{position: [1, 0, 0], look_at: [0, 0, 0]}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("keyframes: 3", "has no list of keyframes"),
        ("keyframes: [", "is not readable yaml"),
        (f"- {GOOD}", r"has 1 keyframe\(s\), and a path needs two"),
        (f"- {GOOD}\n- 7", "keyframe 2 is 7, but must name a position"),
        (f"- {GOOD}\n- {{position: [1, 0, .nan]}}", "keyframe 2: position is .1, 0, nan., but must be three finite"),
        (f"- {GOOD}\n- {{position: [1, 0, 0], target: [0, 0, 0]}}", "keyframe 2 has the unknown key 'target'"),
        (f"- {GOOD}\n- {{position: [1, 0, 0]}}", "keyframe 2 must have a position and a look_at"),
        (f"- {GOOD}\n- {{position: [1, 0, 0], look_at: [1, 0, 0]}}", "keyframe 2 looks nowhere"),
        (f"- {GOOD}\n- {{position: [1, 0, 0], look_at: [0, 0, 0], fov: 180}}", "between 0 and 180"),
        (f"- {GOOD}\n- {{position: [1, 0, 0], look_at: [0, 0, 0], time: 1}}", "1 of 2 keyframes have a time"),
        ("\n".join(2 * ["- {position: [1, 0, 0], look_at: [0, 0, 0], time: 1}"]), "its time 1 does not follow 1"),
    ],
)
def test_a_bad_file_is_named(tmp_path, text, words):
    (tmp_path / "keys.yaml").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_keyframes(tmp_path / "keys.yaml")
    assert "keys.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1500


def test_what_cannot_be_filmed_or_without_end_or_swings_beyond_all_cameras_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none.yaml does not exist; the folder holds"):
        KeyframePath(str(tmp_path / "none.yaml"))
    file = keyframe_file(tmp_path, *(Keyframe((x, 0.0, 5.0), look_at=(x, 0.0, 4.0)) for x in (0.0, 1.0)))
    with pytest.raises(InputError, match="keyframe 1 looks straight along its up"):
        KeyframePath(file).cameras(frame())
    keyframes = (Keyframe((x, 0.0, 5.0), look_at=(1.0, 2.0, 3.0), time=1000 * 3600 * x) for x in (0.0, 1.0))
    file = keyframe_file(tmp_path, *keyframes)
    with pytest.raises(InputError, match=r"3\.6e\+06 seconds, which makes 108,000,001 frames at path.fps=30"):
        KeyframePath(file)
    assert len(KeyframePath(file, num_frames=5).cameras(frame()).c2w) == 5
    keys = [
        "{position: [4, 0, 1], look_at: [0, 0, 0.5], fov: 40, time: -809}",
        "{position: [0, 4, 2], look_at: [0, 0, 0.5], up: [0, 0, 1], time: 0.5}",
        "{position: [-4, 0, 1], look_at: [0, 0, 0.5], fov: 22.6, time: 1}",
    ]
    (tmp_path / "keys.yaml").write_text("".join(f"- {key}\n" for key in keys))
    scene = ball_scene()
    with pytest.raises(InputError, match="swings beyond all cameras"):
        KeyframePath(str(tmp_path / "keys.yaml")).cameras(frame_of(scene.cameras, scene.aabb))


def test_the_curve_passes_the_keyframes_at_their_times(tmp_path):
    times = (0.0, 1.0, 1.5)
    file = keyframe_file(
        tmp_path, *(Keyframe(p, look_at=(1.0, 2.0, p[2]), time=t) for p, t in zip(PLACES, times, strict=True))
    )
    cameras = KeyframePath(file, fps=10).cameras(frame())
    assert len(cameras.c2w) == 16
    assert is_rigid(cameras.c2w, tolerance=1e-9).all()
    torch.testing.assert_close(cameras.c2w[[0, 10, 15], :, 3], torch.tensor(PLACES, dtype=torch.float64))
    ahead = -cameras.c2w[10, :, 2]
    torch.testing.assert_close(ahead, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    assert len(KeyframePath(file, num_frames=7).cameras(frame()).c2w) == 7


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("closed", [False, True])
def test_seconds_count_from_any_beginning(tmp_path, dtype, closed):
    around = replace(frame(), center=MIDDLE.to(dtype), up=UP.to(dtype), poses=frame().poses.to(dtype))

    def cameras(beginning):
        keyframes = (
            Keyframe(place, look_at=(1.0, 2.0, 3.0), fov=40.0, time=beginning + second)
            for place, second in zip(PLACES, (0.0, 2.0, 2.25), strict=True)
        )
        return KeyframePath(keyframe_file(tmp_path, *keyframes), closed=closed, fps=8).cameras(around)

    plain, late = cameras(0.0), cameras(1.7e9)
    assert len(plain.c2w) == (27 if closed else 19)
    assert plain.c2w.dtype == plain.focal.dtype == dtype
    assert torch.equal(late.c2w, plain.c2w)
    assert torch.equal(late.focal, plain.focal)


def test_what_all_keyframes_look_at_stays_in_the_middle(tmp_path):
    target = tuple(MIDDLE.tolist())
    file = keyframe_file(tmp_path, *(Keyframe(place, look_at=target) for place in PLACES))
    cameras = KeyframePath(file, num_frames=20, closed=True).cameras(frame())
    for view in range(20):
        torch.testing.assert_close(project(cameras, view, MIDDLE), cameras.center[view])


def test_focal_lengths_go_from_keyframe_to_keyframe(tmp_path):
    file = keyframe_file(
        tmp_path,
        Keyframe((5.0, 2.0, 4.0), look_at=(1.0, 2.0, 3.0), fov=90.0),
        Keyframe((5.0, 3.0, 4.0), look_at=(1.0, 2.0, 3.0), fov=28.0725),
        Keyframe((5.0, 4.0, 4.0), look_at=(1.0, 2.0, 3.0)),
    )
    path = KeyframePath(file, num_frames=3, width=50)
    focal = path.cameras(frame()).focal
    assert focal[:, 0].tolist() == pytest.approx([25.0, 100.0, 70.0], rel=0.02)  # of a picture half as wide
    assert KeyframePath(file, num_frames=3, fov=90.0).cameras(frame()).focal[1].tolist() == pytest.approx([50.0, 50.0])


def test_a_rotation_about_one_axis_stays_about_it_past_half_a_turn():
    angle = torch.deg2rad(torch.tensor([0.0, 100.0, 200.0, 300.0], dtype=torch.float64))
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rotations = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).view(4, 3, 3)
    at = torch.linspace(0, 3, 31, dtype=torch.float64)
    found = rotations_along(torch.arange(4.0, dtype=torch.float64), rotations, at)
    assert found[:, 2, 2].tolist() == pytest.approx([1.0] * 31)
    turned = torch.atan2(found[:, 1, 0], found[:, 0, 0])
    steps = turned.diff().remainder(2 * math.pi)
    assert bool((steps < math.radians(25)).all())  # always forward, never the long way round
    torch.testing.assert_close(found[::10], rotations)
