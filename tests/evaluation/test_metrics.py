import math

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from nerf_lightning.evaluation.metrics import (
    SSIM_WINDOW,
    image_metrics,
    mean_over_images,
    median_over_images,
    worst_of_images,
)
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.training.validation import RayErrors


def pair(mse, size=16):
    truth = torch.full((size, size, 3), 0.3)
    return truth + math.sqrt(mse), truth


def test_psnr_by_hand_finite_where_pictures_are_equal_and_averaged_over_images_not_pooled():
    torch.testing.assert_close(psnr(torch.tensor([1.0, 0.01, 1e-4])), torch.tensor([0.0, 20.0, 40.0]))
    torch.testing.assert_close(psnr(torch.tensor([0.0, 1e-12, 1e-10])), torch.tensor([100.0, 100.0, 100.0]))
    assert psnr(torch.tensor(math.nan)).isnan()
    errors = [0.1, 0.001]
    mean = mean_over_images([image_metrics(*pair(mse)) for mse in errors])
    assert math.isclose(mean["psnr"], 20.0, abs_tol=1e-3)
    pooled = float(psnr(torch.tensor(errors).mean()))
    assert math.isclose(pooled, 12.967, abs_tol=1e-3)


def test_equal_images_are_alike_and_ssim_of_two_flat_ones_by_hand():
    image, white = torch.rand(20, 31, 3), torch.ones(16, 16, 3)
    assert image_metrics(image, image)["psnr"] == image_metrics(1.5 * white, white)["psnr"] == pytest.approx(100.0)
    assert math.isclose(image_metrics(image, image)["ssim"], 1.0, abs_tol=1e-6)
    # No variance, so only the luminance term is left: (2ab + c) / (a^2 + b^2 + c) with c = 0.01^2.
    render, truth = torch.full((16, 16, 3), 0.6), torch.full((16, 16, 3), 0.2)
    wanted = (2 * 0.6 * 0.2 + 1e-4) / (0.36 + 0.04 + 1e-4)
    assert math.isclose(image_metrics(render, truth)["ssim"], wanted, abs_tol=1e-4)


def test_ssim_has_the_window_of_its_paper_and_an_image_that_is_smaller_none():
    """A Gaussian of 1.5 pixels over 11 x 11 of them (Wang et al. 2004)."""
    render, truth = torch.rand(2, 32, 27, 3)
    planes = (picture.movedim(-1, 0)[None] for picture in (render, truth))
    wanted = structural_similarity_index_measure(*planes, sigma=1.5, kernel_size=11, data_range=1.0)
    assert math.isclose(image_metrics(render, truth)["ssim"], float(wanted), abs_tol=1e-6)
    assert image_metrics(*pair(0.01, SSIM_WINDOW - 1))["ssim"] is None
    assert math.isfinite(image_metrics(*pair(0.01, SSIM_WINDOW))["ssim"])
    picture = torch.rand(12, 12, 3)
    assert math.isnan(image_metrics(picture, picture, torch.zeros(12, 12, dtype=torch.bool))["psnr"])


def test_median_and_worst_know_which_way_is_worse():
    rows = [{"psnr": 20.0, "depth_error": 0.1}, {"psnr": 30.0, "depth_error": 0.3}, {"psnr": 22.0, "depth_error": 0.2}]
    assert median_over_images(rows) == {"psnr": 22.0, "depth_error": 0.2}
    assert worst_of_images(rows) == {"psnr": 0, "depth_error": 1}
    lacking = [*rows, {"psnr": 10.0, "depth_error": None}]
    assert mean_over_images(lacking) == {"psnr": 20.5, "depth_error": None}
    assert median_over_images(lacking) == {"psnr": 21.0, "depth_error": None}
    assert worst_of_images(lacking) == {"psnr": 3, "depth_error": None}
    for function in (mean_over_images, median_over_images, worst_of_images):
        with pytest.raises(ValueError, match="no image"):
            function([])


def test_psnr_and_its_standard_error_by_hand():
    errors, target = RayErrors(), torch.zeros(2, 3)
    errors.add(torch.tensor([[0.1] * 3, [0.3] * 3]), target, torch.ones(2))
    # Squared errors 0.01 and 0.09: mean 0.05, standard deviation of the population 0.04, over sqrt(2 - 1).
    wanted = {"val/psnr": 13.0103, "val/psnr_standard_error": 10 / 2.302585 * 0.04 / 0.05}
    assert errors.summary() == pytest.approx(wanted, rel=1e-4)
