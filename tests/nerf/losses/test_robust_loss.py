import pytest
import torch
from support.planted_ball import with_jumping_ball
from support.scenes import ball_scene

from nerf_lightning.data.ray_batches import RayBatches, gather_batch
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.robust import RobustLoss, kept_pixels, residuals
from nerf_lightning.nerf.losses.weighted_sum import WeightedSum
from nerf_lightning.nerf.part import end_step
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import PixelIndex, Target
from nerf_lightning.nerf.types.renderings import Rendering

PATCH = 16


def kept(bad: torch.Tensor) -> torch.Tensor:
    return kept_pixels(~bad.flatten(), PATCH).view(PATCH, PATCH)


def square(top: int, left: int, side: int) -> torch.Tensor:
    bad = torch.zeros(PATCH, PATCH, dtype=torch.bool)
    bad[top : top + side, left : left + side] = True
    return bad


def test_fine_detail_and_small_blobs_are_kept_and_what_is_bad_at_a_border_is_not():
    """Fine detail: large residuals among small ones. The inner half of a square is vouched for by the whole."""
    line = torch.zeros(PATCH, PATCH, dtype=torch.bool)
    line[0::4, :] = True
    for bad in (square(1, 1, 1), line, square(5, 5, 6)):
        assert bool(kept(bad).all())
    expected = torch.ones(PATCH, PATCH, dtype=torch.bool)
    expected[:4, :4] = False
    expected[3, 3] = True  # 5 of its 9 neighbors are good
    assert torch.equal(kept(square(0, 0, 4)), expected)
    mostly = square(0, 0, 13)
    assert not bool(kept(mostly)[:12, :12].any())
    assert bool(kept(mostly)[~mostly].all())


def test_squares_do_not_speak_for_each_other_and_what_is_no_whole_square_is_kept():
    bad = torch.cat([torch.ones(PATCH**2), torch.zeros(PATCH**2), torch.ones(5)]).bool()
    found = kept_pixels(~bad, PATCH)
    assert not bool(found[: PATCH**2].any())
    assert bool(found[PATCH**2 :].all())


def seen(rgb: torch.Tensor) -> Rendering:
    return Rendering(rgb, rgb, rgb[:, 0], rgb[:, 0])


def target(rgb: torch.Tensor, weight: torch.Tensor) -> Target:
    number = torch.zeros(len(rgb), dtype=torch.int64)
    return Target(rgb, weight, PixelIndex(number, number, number))


def a_passer_by() -> tuple[torch.Tensor, torch.Tensor]:
    """Two squares of a picture that is off by 0.01, but for half of the second, which is off by 0.6."""
    truth = torch.full((2 * PATCH**2, 3), 0.3)
    photograph = truth + 0.01
    photograph[PATCH**2 + PATCH**2 // 2 :] += 0.59
    return truth, photograph


def test_the_threshold_comes_down_to_the_quantile_and_the_passer_by_is_left_out_of_every_level():
    truth, photograph = a_passer_by()
    loss, weight = RobustLoss(MeanSquaredError(), share=0.7, times=4.0, patch=PATCH), torch.ones(2 * PATCH**2)
    plain = MeanSquaredError()([seen(truth)] * 2, target(photograph, weight))
    torch.testing.assert_close(loss([seen(truth)] * 2, target(photograph, weight)), plain)  # at first all are kept
    for _ in range(200):
        loss.after_step(truth, photograph, weight)
    assert float(loss.threshold) == pytest.approx(4e-4, rel=1e-3)
    levels = loss([seen(truth)] * 2, target(photograph, weight))["color"]
    # Three quarters of the pixels: none of the passer-by has as many good neighbors as bad ones.
    assert [float(level) for level in levels] == pytest.approx([0.75 * 1e-4] * 2, rel=1e-3)
    loss.reset_parameters()
    torch.testing.assert_close(loss([seen(truth)] * 2, target(photograph, weight)), plain)


def test_a_loss_within_others_learns_too():
    truth, photograph = a_passer_by()
    inner = RobustLoss(MeanSquaredError(), share=0.7, patch=PATCH)
    end_step(WeightedSum({"outer": RobustLoss(inner, patch=PATCH)}), truth, photograph, torch.ones(len(truth)))
    assert float(inner.threshold) < 1.0


def test_masked_pixels_and_steps_without_any_other_teach_nothing():
    truth, photograph = a_passer_by()
    loss = RobustLoss(MeanSquaredError(), share=1.0, times=4.0, patch=PATCH)
    weight = (photograph[:, 0] < 0.5).float()
    for _ in range(200):
        loss.after_step(truth, photograph, weight)
    assert float(loss.threshold) == pytest.approx(4e-4, rel=1e-3)
    before = loss.threshold.clone()
    loss.after_step(truth, photograph, torch.zeros_like(weight))
    loss.after_step(truth * torch.nan, photograph, weight)
    assert torch.equal(loss.threshold, before)


def test_masked_pixels_speak_against_no_neighbour():
    truth, photograph = a_passer_by()
    loss = RobustLoss(MeanSquaredError(), patch=PATCH)
    loss.threshold.fill_(1.1e-4)
    weight = (photograph[:, 0] < 0.5).float()
    found = loss([seen(truth)], target(photograph, weight))["color"]
    assert float(found) == pytest.approx(0.75 * 1e-4, rel=1e-3)


def test_numbers_out_of_range_are_refused():
    for setting, value in (("share", 0.0), ("share", 1.2), ("times", 0.0), ("patch", 3)):
        with pytest.raises(ValueError, match=f"{setting}={value}: give"):
            RobustLoss(MeanSquaredError(), **{setting: value})


def test_of_a_planted_ball_most_is_left_out_and_of_what_the_scene_explains_hardly_anything():
    scene = ball_scene(num_views=4, size=64)
    planted = with_jumping_ball(scene)
    loss = RobustLoss(MeanSquaredError())
    pixels = RayBatches(planted, Progress(), 0, 4096, patch=loss.patch).pixels_at(0, 0)
    clean, photograph = (gather_batch(each, pixels).rgba[:, :3] for each in (scene, planted))
    # The scene is known up to noise.
    seen = clean + 0.02 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    for _ in range(100):
        loss.after_step(seen, photograph, torch.ones(len(pixels.x)))
    kept = kept_pixels(residuals(seen, photograph) <= loss.threshold, loss.patch)
    ball = (photograph - clean).abs().amax(dim=-1) > 0
    assert float(ball.float().mean()) > 0.03
    assert float(kept[ball].float().mean()) < 0.25
    assert float(kept[~ball].float().mean()) > 0.98
