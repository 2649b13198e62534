import pytest
import torch

from nerf_lightning.evaluation.metrics import RayErrors


def test_rays_without_an_error_have_a_finite_psnr_and_nothing_to_doubt():
    errors, rays = RayErrors(), torch.rand(8, 3)
    errors.add(rays, rays, torch.ones(8))
    assert errors.summary() == {"val/psnr": pytest.approx(100.0), "val/psnr_standard_error": 0.0}


def test_psnr_and_its_standard_error_by_hand():
    errors, target = RayErrors(), torch.zeros(2, 3)
    errors.add(torch.tensor([[0.1] * 3, [0.3] * 3]), target, torch.ones(2))
    # Squared errors 0.01 and 0.09: mean 0.05, standard deviation of the population 0.04, over sqrt(2 - 1).
    wanted = {"val/psnr": 13.0103, "val/psnr_standard_error": 10 / 2.302585 * 0.04 / 0.05}
    assert errors.summary() == pytest.approx(wanted, rel=1e-4)
