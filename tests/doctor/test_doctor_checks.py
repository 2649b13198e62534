from dataclasses import replace

import pytest
import torch
from support.captures import real_capture
from support.doctor_scene import VIEWS, but_poses, corner_analysis, corner_scene, with_pictures, with_poses, with_scene
from support.scenes import ball_scene
from torch.nn.functional import avg_pool2d

from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.doctor import extent, gate
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import advice, analyze, examine
from nerf_lightning.doctor.features import fineness_of
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import PixelStore

TYPED = {"near": "8", "far": "12"}
"""What the protocol of a scene has where a person has said it."""


def judged(analysis, name, verdict, *fragments):
    check = but_poses(analysis)[name]
    assert check.verdict == verdict, check
    for fragment in fragments:
        assert fragment in check.message + " " + check.cure
    return check


def smeared(picture, radius=4):
    soft = torch.nn.functional.avg_pool2d(picture[..., :3].float().permute(2, 0, 1), 2 * radius + 1, 1, radius)
    picture[..., :3] = soft.permute(1, 2, 0).to(torch.uint8)


def test_fineness_does_not_depend_on_contrast():
    pixels = corner_scene().pixels
    flat = replace(pixels, rgba=torch.cat([pixels.rgba[:, :3] // 2 + 50, pixels.rgba[:, 3:]], dim=1))
    torch.testing.assert_close(fineness_of(flat, 0), fineness_of(pixels, 0), atol=0.1, rtol=0)


def moved_camera(rgba, height, width):
    """What it gets while its picture moves by so many pixels, down or across."""
    kernel = (height, width)
    alpha = rgba[..., 3:] / 255
    light = torch.cat([rgba[..., :3] * alpha, 255 * alpha], dim=-1).permute(2, 0, 1)
    soft = torch.nn.functional.avg_pool2d(light, kernel, 1, (height // 2, width // 2), count_include_pad=False)
    rgb = soft[:3] / (soft[3:] / 255).clamp(min=1e-6)
    return torch.cat([rgb, soft[3:]]).round().to(torch.uint8).permute(1, 2, 0)


def test_a_photograph_whose_camera_moved_is_named_and_no_sharp_one():
    scene = corner_scene()
    sharp = analyze(scene)
    judged(sharp, "sharpness", "ok")
    for view, height, width in ((3, 1, 5), (5, 5, 1), (7, 9, 1)):
        pixels, fineness = replace(scene.pixels, rgba=scene.pixels.rgba.clone()), sharp.looks.fineness.clone()
        pixels.view(view)[...] = moved_camera(pixels.view(view), height, width)
        fineness[view] = fineness_of(pixels, view)
        soft = replace(sharp, looks=replace(sharp.looks, fineness=fineness))
        check = judged(soft, "sharpness", "look", "1 of")
        assert check.message.split("blurred: ")[1].split(";")[0] == scene.view_names[view]


@pytest.mark.parametrize("step", [2, 3])
def test_sharpness_does_not_depend_on_how_far_photographs_are_shrunk(step):
    torch.manual_seed(0)
    picture = avg_pool2d(torch.rand(1, 3, 1448, 2168), 9, stride=1)
    whole, shrunk = (fineness_of(store_of(255 * each), 0) for each in (picture, avg_pool2d(picture, step)))
    torch.testing.assert_close(shrunk, whole, atol=0.1, rtol=0)


def store_of(picture):
    """A store of one opaque picture, its channels first."""
    height, width = picture.shape[2:]
    rgba = torch.cat([picture[0], torch.full((1, height, width), 255.0)]).permute(1, 2, 0).reshape(-1, 4)
    sizes = (torch.tensor([each]) for each in (0, width, height))
    return PixelStore(rgba.round().to(torch.uint8), *sizes, False, None)


def test_without_texture_sharpness_is_not_judged():
    judged(
        with_pictures(lambda rgba: rgba[:, :1, :1].expand_as(rgba)), "sharpness", "not judged", "0 of 12", "It needs"
    )


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


def test_a_near_plane_behind_the_content_is_wrong_and_the_cure_fits_and_inches_are_named():
    near = torch.full((VIEWS,), 8.0)
    judged(with_scene(near=near), "near and far", "look", "in front of near", "Set scene.near=")  # this program's guess
    check = judged(with_scene(near=near, protocol=TYPED), "near and far", "wrong", "in front of near")
    near = float(check.cure.split("near=")[1].split()[0])
    judged(with_scene(near=torch.full((VIEWS,), near)), "near and far", "ok")
    scene = corner_scene()
    found = but_poses(corner_analysis())["near and far"].message
    low, high = (float(found.split("lies ")[1].split()[place]) for place in (0, 2))
    near, far = torch.full((VIEWS,), 39.37 * low), torch.full((VIEWS,), 39.37 * high)
    judged(with_scene(near=near, far=far, protocol=TYPED), "near and far", "wrong", "inches", "too large")
    assert scene.near[0] < low


@pytest.mark.parametrize("near", [0.0, 1.0])
def test_content_at_the_very_cameras_has_no_unit(monkeypatch, near):
    at_cameras = (torch.arange(VIEWS), torch.zeros(VIEWS))
    monkeypatch.setattr(extent, "content_distances", lambda analysis: at_cameras)
    analysis = with_scene(near=torch.full((VIEWS,), near), far=torch.full((VIEWS,), near - 0.1), protocol=TYPED)
    assert extent.near_and_far(analysis).verdict == "wrong"


@pytest.mark.parametrize(
    ("changes", "name", "verdict", "fragments"),
    [
        ({"far": torch.full((VIEWS,), 0.9), "protocol": TYPED}, "near and far", "wrong", ("behind far",)),
        ({"left_out": ("a.jpg", "b.jpg")}, "photographs without pose", "look", ("2 of 14", "a.jpg, b.jpg")),
        ({"left_out": tuple("abcdefghijklmnop")}, "photographs without pose", "look", ("16 of 28",)),
        ({"splits": {"train": (0, 1, 2), "val": (2, 3), "test": (3,)}}, "split", "wrong", ("view 2.png",)),
        ({"splits": {"train": (1, 2), "val": (0,), "test": (0,)}}, "number of views", "wrong", ("2 for training",)),
        (
            {"splits": {"train": (1, 2), "val": (0,), "test": (0,)}, "left_out": tuple("abcd")},
            "number of views",
            "wrong",
            ("4 that are left out", "scene=photos scene.root=FOLDER"),
        ),
    ],
)
def test_what_the_scene_says_of_itself(changes, name, verdict, fragments):
    judged(with_scene(**changes), name, verdict, *fragments)


def test_a_background_that_is_baked_in_or_was_cut_out_is_named():
    scene = ball_scene(8, 24, background="black")
    rgba = scene.pixels.rgba.clone()
    rgba[rgba[:, 3] == 0] = 255
    pixels = replace(scene.pixels, rgba=rgba, has_transparency=False)
    analysis = analyze(replace(scene, pixels=pixels))
    judged(analysis, "background", "wrong", "opaque on a background that is white", "scene.background=white")
    judged(replace(analysis, scene=replace(analysis.scene, background="white")), "background", "ok")
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
    cut = replace(white, scene=replace(white.scene, protocol={"cut_out": "black"}))
    judged(cut, "transparency", "ok")
    faded = with_pictures(lambda rgba: fade(rgba, straight=True))
    judged(replace(faded, scene=replace(faded.scene, background="white")), "transparency", "ok")


def test_hard_outlines_do_not_tell_whether_colours_are_multiplied_by_alpha():
    def cut(rgba):
        rgba[:, :, :100] = 0
        rgba[:, :, 100, 3] = 254
        return rgba

    hard = with_pictures(cut)
    check = judged(
        replace(hard, scene=replace(hard.scene, background="white")), "transparency", "not judged", "It needs"
    )
    assert "69 % of the pixels show the content" in check.message


def test_masks_that_keep_nothing_are_named():
    scene = corner_scene()
    mask = torch.ones(len(scene.pixels.rgba), dtype=torch.uint8)
    mask[: len(mask) // VIEWS] = 0
    analysis = analyze(replace(scene, pixels=replace(scene.pixels, mask=mask)))
    judged(analysis, "masks", "look", "view 0.png", "invert them")


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
        ("c2w", lambda c2w: rolled(c2w, 2), "upright", "look", "upside down"),
        ("c2w", lambda c2w: c2w * torch.tensor([1.0, 1, 1, 0]), "rotations", "wrong", "are at the same position"),
        ("c2w", lambda c2w: c2w * torch.tensor([-1.0, 1, 1, 1]), "rotations", "wrong", "not rotations"),
    ],
)
def test_cameras_that_no_photographer_has_are_named(attribute, change, name, verdict, says):
    cameras = corner_scene().cameras
    changed = change(getattr(cameras, attribute).clone())
    analysis = (
        with_poses(changed) if attribute == "c2w" else with_scene(cameras=replace(cameras, **{attribute: changed}))
    )
    judged(analysis, name, verdict, says)


def test_cameras_that_look_away_are_wrong_without_any_detail():
    scene = ball_scene(10, 12)
    flipped = torch.cat([scene.cameras.c2w[..., :3] * torch.tensor([1.0, -1, -1]), scene.cameras.c2w[..., 3:]], dim=-1)
    analysis, _ = examine(replace(scene, cameras=replace(scene.cameras, c2w=flipped)))
    judged(analysis, "camera directions", "wrong", "OpenCV's axes rather than OpenGL's")
    judged(analysis, "scene box", "wrong")


@pytest.mark.parametrize(("factor", "says"), [(0.1, "inside it"), (40.0, "a dot")])
def test_a_capture_of_another_scale_than_its_box_is_wrong(factor, says):
    scene = ball_scene(10, 12)
    c2w = scene.cameras.c2w * torch.tensor([1.0, 1, 1, factor])
    analysis = analyze(replace(scene, cameras=replace(scene.cameras, c2w=c2w)))
    judged(analysis, "scale", "wrong", says)


def test_a_hole_in_a_ring_of_views_is_noted():
    scene = ball_scene(16, 12)
    judged(analyze(scene), "coverage", "ok", "seen from 33")
    kept = torch.arange(12)
    cameras = replace(scene.cameras[kept], lens_model="pinhole")
    analysis = analyze(ball_scene(12, 12))
    analysis = replace(analysis, scene=replace(analysis.scene, cameras=cameras))
    judged(analysis, "coverage", "look", "gap of 112 degrees", "Take 12 more photographs between ball_11 and ball_0")


@pytest.mark.data
@pytest.mark.parametrize(
    ("reader", "name", "looks"),
    [
        (LlffReader, "fern", set()),
        pytest.param(TransformsReader, "fox", set(), marks=pytest.mark.exhaustive),
        # 4.jpg and some more were taken while the hand moved.
        pytest.param(ColmapReader, "cup_colmap", {"upright", "sharpness"}, marks=pytest.mark.exhaustive),
    ],
)
def test_good_captures_raise_no_alarm(reader, name, looks):
    _, checks = examine(reader(root=str(real_capture(name))).read())
    assert {check.name: check.message for check in checks if check.verdict == "wrong"} == {}
    assert {check.name for check in checks if check.verdict == "look"} <= looks


@pytest.fixture
def verdicts(monkeypatch):
    """What the doctor says."""
    said = []
    monkeypatch.setattr(gate, "examine", lambda scene: (None, said))
    return said


def test_what_is_wrong_stops_the_training_with_the_cure_and_what_else_is_wrong(verdicts):
    verdicts += [
        Check("sharpness", "look", "3 of 20 are blurred", "Leave them out."),
        Check("convention", "wrong", "every camera looks away", "Turn the poses."),
        Check("focal length", "wrong", "twice too long", "Halve it."),
    ]
    with pytest.raises(
        InputError, match=r"convention: every camera looks away\. Turn the poses\. Also wrong: focal"
    ) as stop:
        gate.require_sound(ball_scene())
    assert "doctor=off trains anyway" in str(stop.value)


def test_what_is_doubtful_is_said_and_training_goes_on(verdicts, caplog):
    caplog.set_level("INFO")
    verdicts += [Check("sharpness", "look", "3 of 20 are blurred", "Leave them out."), Check("lens", "ok", "none")]
    verdicts += [Check("overlap", "not judged", "too few details", "It needs more.")]
    gate.require_sound(ball_scene())
    assert "doctor: sharpness: 3 of 20 are blurred. Leave them out." in caplog.text
    assert "2 checks found no problem; not judged: overlap (doctor=off" in caplog.text


def test_the_one_advice_is_about_what_no_setting_makes_up_for():
    sharp = Check("sharpness", "look", "3 of 20 are blurred", "Leave them out.")
    gap = Check("coverage", "look", "a gap of 90 degrees", "Take some around 142 degrees.")
    assert advice([Check("lens", "ok", "none"), sharp, gap]) == "Take some around 142 degrees."
    assert advice([sharp]) == "Leave them out."
    assert advice([Check("lens", "ok", "none"), Check("overlap", "not judged", "too few", "It needs more.")]) is None
