from dataclasses import replace

import pytest
import torch
from support.captures import real_capture
from support.doctor_scene import VIEWS, but_poses, corner_evidence, corner_scene, with_pictures, with_poses, with_scene
from support.scenes import ball_scene

from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.doctor import check, extent
from nerf_lightning.doctor.examine import examine, gather_evidence
from nerf_lightning.doctor.features import sharpness_of


def judged(evidence, name, verdict, *fragments):
    check = but_poses(evidence)[name]
    assert check.verdict == verdict, check
    for fragment in fragments:
        assert fragment in check.message + " " + check.cure
    return check


def smeared(picture, radius=4):
    soft = torch.nn.functional.avg_pool2d(picture[..., :3].float().permute(2, 0, 1), 2 * radius + 1, 1, radius)
    picture[..., :3] = soft.permute(1, 2, 0).to(torch.uint8)


def test_sharpness_does_not_depend_on_contrast():
    pixels = corner_scene().pixels
    flat = replace(pixels, rgba=torch.cat([pixels.rgba[:, :3] // 2 + 50, pixels.rgba[:, 3:]], dim=1))
    assert float(sharpness_of(flat, 0)) == pytest.approx(float(sharpness_of(pixels, 0)), rel=0.1)


def scaled(picture, *factors):
    picture[..., :3] = (picture[..., :3].float() * torch.tensor(factors)).to(torch.uint8)


PICTURES = {
    "blurred": (lambda rgba: smeared(rgba[7]), "sharpness", "view 7.png", "1 of 12"),
    "dark": (lambda rgba: scaled(rgba[4], 0.55, 0.55, 0.55), "exposure", "view 4.png differ in brightness (0.5"),
    "tinted": (lambda rgba: scaled(rgba[4], 0.7, 1.0, 1.0), "exposure", "view 4.png differ in white balance"),
    "copied": (lambda rgba: rgba[1].copy_(rgba[0]), "duplicates", "view 0.png and view 1.png", "scores will be too"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_an_odd_photograph_is_named(name):
    change, check, *fragments = PICTURES[name]

    def changed(rgba):
        change(rgba)
        return rgba

    judged(with_pictures(changed), check, "look", *fragments)


def test_views_are_compared_a_few_at_a_time(monkeypatch):
    def copy(rgba):
        rgba[1], rgba[9] = rgba[0], rgba[8]
        return rgba

    evidence = with_pictures(copy)
    whole = but_poses(evidence)
    del whole["memory"]  # what is free changes
    monkeypatch.setattr(check, "PAIRS_AT_ONCE", 5 * VIEWS)
    assert check.rows_at_once(VIEWS) == 5
    assert whole.items() <= but_poses(evidence).items()
    judged(evidence, "duplicates", "look", "2 pairs")


def test_a_near_plane_behind_the_content_is_wrong_and_the_cure_fits():
    evidence = with_scene(near=torch.full((VIEWS,), 8.0))
    check = judged(evidence, "near and far", "wrong", "in front of near", "Set scene.near=")
    near = float(check.cure.split("near=")[1].split()[0])
    judged(with_scene(near=torch.full((VIEWS,), near)), "near and far", "ok")


def test_near_and_far_in_inches_are_named():
    scene = corner_scene()
    found = but_poses(corner_evidence())["near and far"].message
    low, high = (float(found.split("lies ")[1].split()[place]) for place in (0, 2))
    near, far = torch.full((VIEWS,), 39.37 * low), torch.full((VIEWS,), 39.37 * high)
    judged(with_scene(near=near, far=far), "near and far", "wrong", "inches", "too large")
    assert scene.near[0] < low


@pytest.mark.parametrize("near", [0.0, 1.0])
def test_content_at_the_very_cameras_has_no_unit(monkeypatch, near):
    at_cameras = (torch.arange(VIEWS), torch.zeros(VIEWS))
    monkeypatch.setattr(extent, "content_distances", lambda evidence: at_cameras)
    evidence = with_scene(near=torch.full((VIEWS,), near), far=torch.full((VIEWS,), near - 0.1))
    assert extent.near_and_far(evidence).verdict == "wrong"


@pytest.mark.parametrize(
    ("changes", "name", "verdict", "fragments"),
    [
        ({"far": torch.full((VIEWS,), 0.9)}, "near and far", "wrong", ("behind far",)),
        ({"left_out": ("a.jpg", "b.jpg")}, "photographs without pose", "look", ("2 of 14", "a.jpg, b.jpg")),
        ({"left_out": tuple("abcdefghijklmnop")}, "photographs without pose", "look", ("16 of 28",)),
        ({"splits": {"train": (0, 1, 2), "val": (2, 3), "test": (3,)}}, "split", "wrong", ("view 2.png",)),
        ({"splits": {"train": (1, 2), "val": (0,), "test": (0,)}}, "number of views", "wrong", ("2 to learn",)),
    ],
)
def test_what_the_scene_says_of_itself(changes, name, verdict, fragments):
    judged(with_scene(**changes), name, verdict, *fragments)


def test_a_background_that_is_baked_in_is_named():
    scene = ball_scene(8, 24, background="black")
    rgba = scene.pixels.rgba.clone()
    rgba[rgba[:, 3] == 0] = 255
    pixels = replace(scene.pixels, rgba=rgba, has_transparency=False)
    evidence = gather_evidence(replace(scene, pixels=pixels))
    judged(evidence, "background", "wrong", "opaque on a background that is white", "scene.background=white")
    judged(replace(evidence, scene=replace(evidence.scene, background="white")), "background", "ok")


def test_a_background_that_was_cut_out_is_named():
    cut = {"background": "black", "protocol": {"cut_out": "white"}}
    judged(with_scene(**cut), "background", "look", "plain white, which was made transparent", "scene.background=white")
    judged(with_scene(**cut | {"background": "white"}), "background", "ok")
    judged(with_scene(**cut | {"protocol": {"cut_out": "rgb(9, 90, 9)"}}), "background", "ok", "plain rgb(9, 90, 9)")


def test_colours_multiplied_by_alpha_are_named():
    def fade(rgba, straight):
        alpha = torch.arange(rgba.shape[2]).float() / rgba.shape[2]
        colour = torch.full_like(rgba[..., :3], 230).float()
        rgba[..., :3] = (colour if straight else colour * alpha[:, None]).to(torch.uint8)
        rgba[..., 3] = (255 * alpha).to(torch.uint8)
        return rgba

    faded = with_pictures(lambda rgba: fade(rgba, straight=False))
    white = replace(faded, scene=replace(faded.scene, background="white"))
    judged(white, "transparency", "look", "multiplied by alpha", "straight alpha")
    faded = with_pictures(lambda rgba: fade(rgba, straight=True))
    judged(replace(faded, scene=replace(faded.scene, background="white")), "transparency", "ok")


def test_masks_that_keep_nothing_are_named():
    scene = corner_scene()
    mask = torch.ones(len(scene.pixels.rgba), dtype=torch.uint8)
    mask[: len(mask) // VIEWS] = 0
    evidence = gather_evidence(replace(scene, pixels=replace(scene.pixels, mask=mask)))
    judged(evidence, "masks", "look", "view 0.png", "invert them")


def rolled(c2w, quarters):
    right, up, back, center = c2w.unbind(dim=-1)
    sides = {1: (-up, right), 2: (-right, -up)}[quarters]
    return torch.stack([*sides, back, center], dim=-1)


def cropped(center):
    return torch.where(torch.arange(VIEWS)[:, None] % 3 == 0, 0.5, 1.0) * center


@pytest.mark.parametrize(
    ("attribute", "change", "name", "verdict", "says"),
    [
        ("center", lambda center: 0.5 * center, "principal point", "wrong", "photographs of 0.5 times the size"),
        ("center", cropped, "principal point", "look", "cropped is fine"),  # elsewhere each
        ("focal", lambda focal: 30 * focal, "field of view", "wrong", ""),
        ("focal", lambda focal: 0.05 * focal, "field of view", "wrong", ""),
        ("focal", lambda focal: torch.tensor([1.0, 1.3]) * focal, "field of view", "look", "not square"),
        ("c2w", lambda c2w: rolled(c2w, 1), "upright", "look", "on their side"),
        ("c2w", lambda c2w: rolled(c2w, 2), "upright", "look", "on their head"),
        ("c2w", lambda c2w: c2w * torch.tensor([1.0, 1, 1, 0]), "rotations", "wrong", "stand at one place"),
        ("c2w", lambda c2w: c2w * torch.tensor([-1.0, 1, 1, 1]), "rotations", "wrong", "no rotations"),
    ],
)
def test_cameras_that_no_photographer_has_are_named(attribute, change, name, verdict, says):
    cameras = corner_scene().cameras
    changed = change(getattr(cameras, attribute).clone())
    evidence = (
        with_poses(changed) if attribute == "c2w" else with_scene(cameras=replace(cameras, **{attribute: changed}))
    )
    judged(evidence, name, verdict, says)


def test_cameras_that_look_away_are_wrong_without_any_detail():
    scene = ball_scene(10, 12)
    flipped = torch.cat([scene.cameras.c2w[..., :3] * torch.tensor([1.0, -1, -1]), scene.cameras.c2w[..., 3:]], dim=-1)
    evidence, _ = examine(replace(scene, cameras=replace(scene.cameras, c2w=flipped)))
    judged(evidence, "common middle", "wrong", "OpenCV's axes rather than OpenGL's")
    judged(evidence, "box in view", "wrong")


@pytest.mark.parametrize(("factor", "says"), [(0.1, "within it"), (40.0, "a dot")])
def test_a_capture_of_another_scale_than_its_box_is_wrong(factor, says):
    scene = ball_scene(10, 12)
    c2w = scene.cameras.c2w * torch.tensor([1.0, 1, 1, factor])
    evidence = gather_evidence(replace(scene, cameras=replace(scene.cameras, c2w=c2w)))
    judged(evidence, "scale", "wrong", says)


def test_a_hole_in_a_ring_of_views_is_noted():
    scene = ball_scene(16, 12)
    judged(gather_evidence(scene), "coverage", "ok", "seen from 33")
    kept = torch.arange(12)
    cameras = replace(scene.cameras[kept], lens_model="pinhole")
    evidence = gather_evidence(ball_scene(12, 12))
    evidence = replace(evidence, scene=replace(evidence.scene, cameras=cameras))
    judged(evidence, "coverage", "look", "gap of 112 degrees", "Photographs are missing around")


@pytest.mark.data
@pytest.mark.parametrize(
    ("reader", "name", "looks"),
    [
        (LlffReader, "fern", set()),
        pytest.param(TransformsReader, "fox", set(), marks=pytest.mark.exhaustive),
        pytest.param(ColmapReader, "cup_colmap", {"upright"}, marks=pytest.mark.exhaustive),
    ],
)
def test_good_captures_raise_no_alarm(reader, name, looks):
    _, checks = examine(reader(root=str(real_capture(name))).read())
    assert {check.name: check.message for check in checks if check.verdict == "wrong"} == {}
    assert {check.name for check in checks if check.verdict == "look"} <= looks
