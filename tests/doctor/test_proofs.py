"""A pose is called wrong only with a proof that a person can check: another pose that fits, and a picture of both."""

from dataclasses import replace

import pytest
import torch
from support.doctor_scene import VIEWS, corner_analysis, corner_scene, with_poses

from nerf_lightning.doctor.conventions import FLIP_YZ, axes
from nerf_lightning.doctor.epipolar import agreeing, line_distances
from nerf_lightning.doctor.features import Corners
from nerf_lightning.doctor.picture import proof_picture
from nerf_lightning.doctor.poses import CHECKS, poses_and_pixels, single_poses
from nerf_lightning.doctor.second_opinion import better_pose, is_vouched_for

VIEW = 5


def with_mistaken_matches(analysis, share=1.0, view=VIEW):
    """A part of one photograph's details were taken for others that look the same."""
    random = torch.Generator().manual_seed(2)
    rows = (analysis.matches.view == view).any(dim=1).nonzero()[:, 0]
    rows = rows[torch.rand(len(rows), generator=random) < share]
    plane = analysis.matches.plane.clone()
    plane[rows, 1] = plane[rows[torch.randperm(len(rows), generator=random)], 1]
    matches = replace(analysis.matches, plane=plane)
    return replace(analysis, matches=matches, agrees=agreeing(matches, analysis.scene.cameras.c2w))


def without_corners(analysis, view=VIEW):
    """Nothing can be found again in one photograph."""
    blank = Corners(torch.zeros(0, 2), analysis.corners[view].descriptor[:0], torch.zeros(0, 3))
    return replace(analysis, corners={**analysis.corners, view: blank})


def turned(degrees, view=VIEW):
    c2w = corner_scene().cameras.c2w.clone()
    x, y, z = torch.nn.functional.normalize(torch.tensor([1.0, 0.5, 0.0]), dim=0).tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    c2w[view, :, :3] = torch.matrix_exp(cross * torch.deg2rad(torch.tensor(degrees))) @ c2w[view, :, :3]
    return with_poses(c2w)


def test_a_pose_that_the_nearest_views_confirm_is_right_whatever_others_say():
    check = single_poses(with_mistaken_matches(corner_analysis()))
    assert check.verdict == "ok"
    assert "view 5.png agree with the nearest views" in check.message


def test_matches_that_no_pose_explains_prove_nothing():
    analysis = without_corners(with_mistaken_matches(corner_analysis()))
    others = [view for view in range(VIEWS) if view != VIEW]
    assert not is_vouched_for(analysis, VIEW, others)
    assert better_pose(analysis, VIEW, [VIEW]) is None
    check = single_poses(analysis)
    assert check.verdict == "not judged"
    assert "view 5.png share with others lie where the cameras say, but no other pose fits better" in check.message


def test_a_pose_that_explains_less_than_most_of_the_matches_proves_nothing():
    """It may belong to the other side of a thing whose sides look alike."""
    analysis = with_mistaken_matches(turned(10.0), 0.5)
    assert better_pose(turned(10.0), VIEW, [VIEW]) is not None
    assert better_pose(analysis, VIEW, [VIEW]) is None
    assert single_poses(analysis).verdict == "not judged"


@pytest.mark.parametrize("degrees", [3.0, 10.0])
def test_the_pose_that_fits_is_the_one_before_the_camera_was_turned(degrees):
    analysis = turned(degrees)
    found = better_pose(analysis, VIEW, [VIEW])
    assert found.degrees == pytest.approx(degrees, abs=0.4)
    right = corner_scene().cameras.c2w
    apart = float((found.pose[:, 3] - right[VIEW, :, 3]).norm())
    assert apart < 0.05 * float((right[0, :, 3] - right[-1, :, 3]).norm())
    check = single_poses(analysis)
    assert check.verdict == "wrong"
    assert "the pose of view 5.png contradicts" in check.message
    assert "degrees away" in check.message


def test_a_proof_holds_details_off_the_given_lines_and_on_those_that_fit_and_has_a_row_in_the_picture():
    analysis = turned(5.0)
    (proof,) = single_poses(analysis).proofs
    assert len(proof.matches.view) >= 8
    assert set(proof.matches.view[:, 0].tolist()) == {VIEW}
    assert float(line_distances(proof.matches, analysis.scene.cameras.c2w).median()) > 4.0
    assert bool((line_distances(proof.matches, proof.fits.c2w) < 1.5).all())
    one, two = (proof_picture(analysis.scene, [proof] * count) for count in (1, 2))
    assert one.shape[1] == two.shape[1]
    assert two.shape[0] > 1.8 * one.shape[0]
    assert int(one.float().std()) > 10


def test_another_convention_is_proved_with_cameras_that_fit():
    analysis = with_poses(axes(corner_scene().cameras.c2w, FLIP_YZ))
    (proof,) = CHECKS["axes"](analysis).proofs
    assert bool((line_distances(proof.matches, proof.fits.c2w) < 1.5).all())
    assert not bool(agreeing(proof.matches, analysis.scene.cameras.c2w).any())


def with_mistaken_pairs(analysis, share):
    """Of so many pairs of photographs, the details were taken for others that look the same."""
    _, pair = analysis.matches.view.unique(dim=0, return_inverse=True)
    random = torch.Generator().manual_seed(4)
    plane = analysis.matches.plane.clone()
    for number in torch.randperm(int(pair.max()) + 1, generator=random)[: int(share * (int(pair.max()) + 1))].tolist():
        rows = (pair == number).nonzero()[:, 0]
        plane[rows, 1] = plane[rows[torch.randperm(len(rows), generator=random)], 1]
    matches = replace(analysis.matches, plane=plane)
    return replace(analysis, matches=matches, agrees=agreeing(matches, analysis.scene.cameras.c2w))


def test_mistakes_prove_nothing_of_the_poses():
    analysis = with_mistaken_pairs(corner_analysis(), 1.0)
    assert analysis.agreement < 0.3
    for judge in (poses_and_pixels, *CHECKS.values()):
        check = judge(analysis)
        assert check.verdict == "not judged"
        assert check.cure


def test_a_few_clear_pairs_tell_whether_all_poses_are_right():
    right = with_mistaken_pairs(corner_analysis(), 0.7)
    assert right.agreement < 0.4
    assert poses_and_pixels(right).verdict == "ok"
    single = single_poses(right)
    assert single.verdict == "not judged"
    assert "too few to tell one view from another" in single.message
    order = torch.randperm(VIEWS, generator=torch.Generator().manual_seed(3))
    wrong = with_mistaken_pairs(with_poses(corner_scene().cameras.c2w[order]), 0.7)
    check = poses_and_pixels(wrong)
    assert check.verdict == "wrong"
    assert bool((line_distances(check.proofs[0].matches, check.proofs[0].fits.c2w) < 1.5).all())
