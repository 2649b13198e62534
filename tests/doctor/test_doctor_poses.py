from dataclasses import replace

import pytest
import torch
from support.corner import corner_poses
from support.doctor_scene import VIEWS, corner_analysis, corner_scene, outcome, with_pictures, with_poses

from nerf_lightning.doctor import poses
from nerf_lightning.doctor.conventions import axes, inverted, mirrored, transposed
from nerf_lightning.doctor.epipolar import agreeing, distances, parallax, places
from nerf_lightning.doctor.examine import analyze
from nerf_lightning.doctor.matches import Matches
from nerf_lightning.nerf.geometry.cameras import project
from nerf_lightning.nerf.geometry.poses import flip_yz, quaternion_from_rotation, rotation_from_quaternion


def judged(name, analysis):
    """What the check of this name says: one of them takes longer than all others."""
    return poses.CHECKS[name](analysis)


def c2w():
    return torch.from_numpy(corner_poses(VIEWS)).float()  # the scene's, without its photographs


def moved(view):
    poses = c2w().clone()
    poses[view, :, 3] += torch.tensor([0.4, -0.5, 0.6])
    return poses


def swapped(first, second):
    order = list(range(VIEWS))
    order[first], order[second] = order[second], order[first]
    return c2w()[order]


def w2c(poses):
    rotation = flip_yz(poses)[:, :, :3].mT
    return rotation, -rotation @ poses[:, :, 3:]


def from_w2c(rotation, translation):
    return flip_yz(torch.cat([rotation.mT, -rotation.mT @ translation], dim=-1))


def with_centers(poses):
    """The poses of a file that has centers where readers expect translations."""
    return from_w2c(w2c(poses)[0], poses[:, :, 3:])


def with_quaternions(poses):
    """The poses of a file whose quaternions x, y, z, w are read as w, x, y, z."""
    rotation, translation = w2c(poses)
    xyzw = quaternion_from_rotation(rotation)[:, [1, 2, 3, 0]]
    return from_w2c(rotation_from_quaternion(xyzw), translation)


def test_a_sound_capture_has_nothing_wrong():
    checks = outcome(corner_analysis())
    assert {check.name: check.message for check in checks.values() if check.verdict == "wrong"} == {}
    assert all(checks[name].verdict == "ok" and not checks[name].cure for name in poses.CHECKS)
    assert corner_analysis().agreement > 0.7


@pytest.mark.parametrize(
    ("planted", "name", "says", "cure"),
    [
        (axes(c2w(), (1.0, -1.0, -1.0)), "axes", "OpenCV", "Set scene.axes=opencv, or negate"),
        (inverted(c2w()), "axes", "look like world-to-camera rather", "Set scene.poses=w2c, or invert"),
        (
            inverted(axes(c2w(), (1.0, -1.0, -1.0))),
            "axes",
            "as COLMAP writes them",
            "scene.poses=w2c scene.axes=opencv",
        ),
        (transposed(c2w()), "axes", "rotations were transposed", "Transpose every rotation"),
        (mirrored(c2w()), "axes", "left-handed world", "Negate the third row and the third column"),
        (with_centers(c2w()), "axes", "centers stood in the place of translations", "-R c"),
        (with_quaternions(c2w()), "axes", "quaternions were x, y, z, w", "Write the quaternions as w, x, y, z"),
        (axes(c2w(), (-1.0, -1.0, 1.0)), "axes", "cameras' x and y axes", "Negate columns 1 and 2"),
        (c2w().roll(1, 0), "order of photographs", "pose of the next one", "by one"),
        (c2w().roll(-1, 0), "order of photographs", "pose of the previous one", "by one"),
        (c2w().flip(0), "order of photographs", "reversed", "Reverse"),
        (
            c2w()[torch.randperm(VIEWS, generator=torch.Generator().manual_seed(3))],
            "poses match photographs",
            "%",
            "again",
        ),
        (moved(5), "single poses", "view 5.png contradicts", "Remove these views"),
        (swapped(2, 8), "single poses", "view 2.png fits the camera of view 8.png", "swap them back"),
    ],
)
def test_wrong_poses_are_named_with_their_cure(planted, name, says, cure):
    check = judged(name, with_poses(planted))
    assert check.verdict == "wrong"
    assert says in check.message
    assert cure in check.cure


def test_rows_in_numeric_order_are_named():
    names = corner_scene().view_names
    by_text = sorted(range(VIEWS), key=lambda view: names[view])
    # The reader pairs row k with the k-th name as text, but the rows' maker counted.
    views = torch.tensor(by_text)
    sound = corner_analysis()
    back = torch.empty(VIEWS, dtype=torch.long)
    back[views] = torch.arange(VIEWS)
    matches = replace(sound.matches, view=back[sound.matches.view], views=tuple(range(VIEWS)))
    scene = replace(sound.scene, view_names=tuple(names[view] for view in by_text))
    analysis = replace(sound, scene=scene, matches=matches, agrees=agreeing(matches, scene.cameras.c2w))
    check = judged("order of photographs", analysis)
    assert check.verdict == "wrong"
    assert "numbers in the photographs' names" in check.message


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_focal_length_of_another_resolution_is_named(factor):
    scene = corner_scene()
    cameras = replace(scene.cameras, focal=scene.cameras.focal * factor)
    check = judged("focal length", analyze(replace(scene, cameras=cameras)))
    assert check.verdict == "wrong"
    told = float(check.cure.split("about ")[1].split()[0])
    assert told == pytest.approx(300.0, rel=0.11)


def test_cameras_that_all_look_the_same_way_do_not_tell_the_focal_length():
    side_by_side = c2w()[:1].repeat(VIEWS, 1, 1)
    side_by_side[:, :, 3] += 0.1 * torch.arange(VIEWS)[:, None] * side_by_side[:, :, 0]
    scene = corner_scene()
    scene = replace(scene, cameras=replace(scene.cameras, c2w=side_by_side))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    seen = [(project(scene.cameras, view, points) - scene.cameras.center[view]) / 300.0 for view in range(5)]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 4)]
    view = torch.tensor(pairs).repeat_interleave(50, dim=0)
    plane = torch.cat([torch.stack([seen[a], seen[b]], dim=1) for a, b in pairs])
    matches = Matches(view, plane, torch.full((200, 2), 300.0), torch.zeros(200, 2, 3), tuple(range(5)))
    analysis = replace(corner_analysis(), scene=scene, matches=matches, agrees=agreeing(matches, side_by_side))
    assert analysis.agreement == 1.0
    assert judged("focal length", analysis).verdict == "not judged"


def test_mirrored_photographs_are_named():
    check = judged("mirrored photographs", with_pictures(lambda rgba: rgba.flip(2)))
    assert check.verdict == "wrong"
    assert "left to right" in check.message


def exact_matches(first, second):
    """Places in two views of the same random points, computed by `project`."""
    cameras = corner_scene().cameras
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    view = torch.tensor([first, second]).expand(50, 2)
    seen = [(project(cameras, each, points) - cameras.center[each]) / cameras.focal[each] for each in (first, second)]
    focal = torch.full((50, 2), 300.0)
    return Matches(view, torch.stack(seen, dim=1), focal, torch.zeros(50, 2, 3), (first, second)), points


def test_exact_matches_agree_and_lie_where_the_points_are():
    matches, points = exact_matches(0, 5)
    assert bool(agreeing(matches, c2w()).all())
    torch.testing.assert_close(places(matches, c2w()), points, atol=1e-3, rtol=0)
    eyes = c2w()[[0, 5], :, 3]
    torch.testing.assert_close(distances(matches, c2w()), torch.cdist(points, eyes), atol=1e-3, rtol=0)
    assert bool((parallax(matches, c2w()) > 0.1).all())


def test_matches_behind_the_cameras_or_off_their_lines_do_not_agree():
    matches, _ = exact_matches(0, 5)
    assert not bool(agreeing(matches, axes(c2w(), (-1.0, 1.0, -1.0))).any())
    mirrored = replace(matches, plane=-matches.plane)
    assert not bool(agreeing(mirrored, axes(c2w(), (1.0, -1.0, -1.0))).all())
    plane = matches.plane.clone()
    # The cameras move sideways, so lines are roughly level: four pixels up leave them.
    plane[:, 1, 1] += 4.0 / 300.0
    assert float(agreeing(replace(matches, plane=plane), c2w()).float().mean()) < 0.3
