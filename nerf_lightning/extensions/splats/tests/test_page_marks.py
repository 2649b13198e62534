"""Named views, notes and distances of a page: their file, the first view, and how far the page turns."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.running import refused
from support.shiny_ball import all_around, record_of, run_of, shiny_model
from support.splat_page import read_page

from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.extensions.splats.page_file import sway
from nerf_lightning.extensions.splats.page_marks import read_marks
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.world_frame import central_view, similarity

TURN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
RECORD = record_of(all_around(), to_user=similarity(TURN, torch.tensor([50.0, -3.0, 2.0]), 3.0))
UP = torch.tensor([0.0, 0.0, 1.0])


def written(folder, content):
    path = folder / "given.json"
    path.write_text(json.dumps(content))
    return path


def test_a_view_of_a_photograph_is_its_camera_in_the_captures_own_frame(tmp_path):
    (view,) = read_marks(written(tmp_path, {"views": [{"name": "left", "photograph": "ball_3"}]}), RECORD)["views"]
    c2w = RECORD.cameras.c2w[3]
    assert view["name"] == "left"
    np.testing.assert_allclose(view["position"], 3 * TURN @ c2w[:, 3] + torch.tensor([50.0, -3.0, 2.0]), rtol=1e-5)
    ahead = np.subtract(view["look_at"], view["position"])
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), -TURN @ c2w[:, 2], atol=1e-6)
    np.testing.assert_allclose(view["up"], TURN @ c2w[:, 1], atol=1e-6)
    width, focal = float(RECORD.cameras.width[3]), float(RECORD.cameras.focal[3, 0])
    assert math.tan(math.radians(view["fov"] / 2)) == pytest.approx(width / 2 / focal)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        *((bad, "must be an object of lists") for bad in ([1], {"view": []}, {"notes": {}}, {"notes": ["a hinge"]})),
        ({"notes": [{"text": "a", "position": [0, 0, 1]}, {"text": "b", "position": [0, 0]}]}, "notes 2: position is"),
        ({"notes": [{"text": 3, "position": [0, 0, 1]}]}, "text is 3, but must be a text"),
        ({"distances": [{"from": [0, 0, 0], "to": [0, 0, float("nan")]}]}, "distances 1: to is"),
        ({"views": [{"name": "a", "photograph": "ball_9"}]}, "no photograph 'ball_9'; the first is 'ball_0'"),
        ({"views": [{"name": "a", "photograph": "ball_1", "fov": 180}]}, "fov is 180, but must be between 0 and 180"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path, content, said):
    path = written(tmp_path, content)
    refused(read_marks, path, RECORD, parts=(str(path), said))


def exported(folder, **settings):
    what = PageExport(300, 0.0, photographs=2, max_views=0, **settings)
    with torch.no_grad():
        what.export(shiny_model(), record_of(all_around()), folder, 65_536, run_of(all_around()))
    return read_page(folder / "page.html")[0]


def test_marks_are_kept_next_to_the_page_and_the_first_view_is_chosen(tmp_path):
    named = [{"name": name, "photograph": name} for name in ("ball_1", "ball_4")]
    path = written(tmp_path, {"views": [{**named[0], "name": "front"}, named[1]]})
    assert exported(tmp_path, views=str(path), first_view="ball_4", title="A ball")["first_view"] == 1
    assert "<title>A ball</title>" in (tmp_path / "page.html").read_text()
    again = exported(tmp_path, first_view="ball_2")
    assert [view["name"] for view in again["marks"]["views"]] == ["front", "ball_4"]
    assert again["first_view"] is None
    eye = again["cameras"][again["first"]]["eye"]
    np.testing.assert_allclose(eye, record_of(all_around()).cameras.c2w[2, :, 3], atol=1e-6)
    parts = ("what.first_view=back", "views: front, ball_4", "ball_5")
    refused(lambda: exported(tmp_path, first_view="back"), parts=parts)


def around(*degrees):
    """The record of cameras that look at the middle from these directions."""
    angles = torch.deg2rad(torch.tensor(degrees))
    eyes = torch.stack([4 * angles.cos(), 4 * angles.sin(), torch.ones(len(degrees))], dim=-1)
    cameras = RECORD.cameras[: len(degrees)]
    views = tuple(range(len(degrees)))
    c2w = look_at(eyes, torch.zeros(len(degrees), 3), UP)
    return replace(RECORD, cameras=replace(cameras, c2w=c2w), splits={"train": views, "test": (0,)})


def test_the_first_view_is_the_most_central_of_the_training_views():
    record = around(0.0, 30.0, 40.0, 10.0, 50.0)
    assert central_view(record) == 1
    assert central_view(replace(record, splits={"train": (4, 0, 3), "test": (1,)})) == 3
    assert central_view(replace(record, splits={"test": (4, 0, 3)})) == 1  # none was trained on: one of all


@pytest.mark.parametrize(
    ("degrees", "wanted"), [((0.0, 90.0, 180.0, 270.0), None), ((350.0, 10.0, 30.0), 10.0), ((0.0, 60.0, 120.0), 20.0)]
)
def test_the_page_turns_as_far_as_the_cameras_stand(degrees, wanted):
    found = sway(around(*degrees), [0.0, 0.0, 0.0], UP)
    assert found == (wanted and pytest.approx(math.radians(wanted), rel=1e-4))
