"""LPIPS by torchmetrics, on a stand-in of torchvision's AlexNet with random weights."""

import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import Mock
from urllib.error import URLError

import pytest
import torch
import torchmetrics
from torch import nn

from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.evaluation.lpips import LPIPS
from nerf_lightning.messages import errors
from nerf_lightning.messages.errors import InputError

WEIGHTS = SimpleNamespace(DEFAULT=SimpleNamespace(url="https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"))


def alexnet(weights):
    assert weights is WEIGHTS.DEFAULT
    torch.manual_seed(3)
    layers = []
    for channels, wider, kernel, stride, padding in (
        (3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1),
    ):  # fmt: skip
        layers += [nn.MaxPool2d(3, 2)] if channels in (64, 192) else []
        layers += [nn.Conv2d(channels, wider, kernel, stride, padding), nn.ReLU()]
    return SimpleNamespace(features=nn.Sequential(*layers))


@pytest.fixture
def torchvision(monkeypatch):
    models = ModuleType("torchvision.models")
    models.alexnet, models.AlexNet_Weights, models.get_model_weights = alexnet, WEIGHTS, lambda name: WEIGHTS
    package = ModuleType("torchvision")
    package.models = models
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    for module in (torchmetrics.image.lpip, torchmetrics.functional.image.lpips):
        monkeypatch.setattr(module, "_TORCHVISION_AVAILABLE", True)
    return models


def test_distance_is_symmetric_positive_and_grows_with_noise_and_too_small_a_picture_has_none(torchvision):
    lpips = LPIPS("alex")
    torch.manual_seed(0)
    truth, noise = torch.rand(48, 64, 3) * 0.5 + 0.25, torch.randn(48, 64, 3)
    assert lpips.score(truth, truth) == 0.0
    scores = [lpips.score(truth + level * noise, truth) for level in (0.01, 0.05, 0.2)]
    assert 0 < scores[0] < scores[1] < scores[2]
    assert lpips.score(truth, truth + 0.05 * noise) == pytest.approx(scores[1], rel=1e-4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert lpips.score(truth + 0.01 * noise, truth) == scores[0]
    lpips = LPIPS("alex")
    assert lpips.score(torch.rand(31, 64, 3), torch.rand(31, 64, 3)) > 0
    assert lpips.score(torch.rand(30, 64, 3), torch.rand(30, 64, 3)) is None


def test_what_is_missing_is_said(torchvision, monkeypatch):
    def offline(weights):
        raise URLError("no route to host")

    monkeypatch.setattr(torchvision, "alexnet", offline)
    with pytest.raises(InputError, match=r"no route to host.*download https://.*7be5be79\.pth .*checkpoints"):
        Scoring(lpips="alex")
    for_another_torch = Mock(side_effect=RuntimeError("operator torchvision::nms does not exist"))
    with monkeypatch.context() as patch:
        patch.setattr(errors, "import_module", for_another_torch)
        with pytest.raises(InputError, match=r"does not load here \(operator torch"):
            Scoring(lpips="alex")
    monkeypatch.setitem(sys.modules, "torchvision.models", None)
    with pytest.raises(InputError, match=r"evaluation.lpips=vgg needs torchvision.*pip install '.\[lpips\]'"):
        Scoring(lpips="vgg")
