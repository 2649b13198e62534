"""Exposures and white balances that were planted are found again."""

import torch
from support.configs import composed
from support.planted_exposures import random_stops
from support.scenes import ball_scene

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.rendering.linear_light import to_linear
from nerf_lightning.nerf.types.rays import PixelIndex

VIEWS, POINTS = 12, 60


def exposure_of(scene):
    correction = build(composed("train", "correction=exposure").correction)
    correction.fit_to(scene)
    return correction


def test_a_stop_doubles_the_light_and_white_balance_keeps_the_exposure():
    correction = exposure_of(ball_scene())
    with torch.no_grad():
        correction.stops[2], correction.stops[3] = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.5, -0.2])
    rgb, zero = torch.tensor([[0.2, 0.4, 0.6]]), torch.zeros(1, dtype=torch.int64)
    shown = [to_linear(correction(rgb, PixelIndex(zero + view, zero, zero))) / to_linear(rgb) for view in (1, 2, 3)]
    torch.testing.assert_close(shown[0], torch.ones(1, 3))
    torch.testing.assert_close(shown[1], torch.full((1, 3), 2.0))
    torch.testing.assert_close(shown[2].log2(), torch.tensor([[0.5, -0.3, -0.2]]), atol=1e-5, rtol=0)


def test_the_penalty_is_of_the_mean_over_the_photographs_that_train():
    scene = ball_scene()
    correction, trained = exposure_of(scene), list(scene.splits["train"])
    with torch.no_grad():
        correction.stops[:] = 9.0
        correction.stops[trained] = torch.tensor([[0.3, 0.0, 0.0], [0.3, 0.1, 0.0], [0.6, 0.2, 0.0]])
    torch.testing.assert_close(correction.penalty(), torch.tensor(0.4**2 + 0.1**2))


def test_planted_exposures_and_the_colours_behind_them_are_found_together():
    """Of points that each are seen in several photographs, as a field's surface is, with noise."""
    torch.manual_seed(0)
    scene = ball_scene(num_views=2 * VIEWS)
    correction, trained = exposure_of(scene), torch.tensor(scene.splits["train"])
    stops = random_stops(len(trained))
    colors = torch.rand(POINTS, 3) * 0.4 + 0.1
    planted = exposure_of(scene)
    with torch.no_grad():
        planted.stops[trained] = stops
    point, view = (each.flatten() for each in torch.meshgrid(torch.arange(POINTS), trained, indexing="ij"))
    seen = PixelIndex(view, torch.zeros_like(view), torch.zeros_like(view))
    shown = planted(colors[point], seen).detach()
    shown += 0.02 * torch.randn_like(shown)
    raw = torch.zeros(POINTS, 3, requires_grad=True)
    groups = [{"params": [raw], "lr": 0.05}, {"params": [correction.stops], "lr": correction.learning_rate}]
    optimizer = torch.optim.Adam(groups)
    for _ in range(300):
        optimizer.zero_grad()
        loss = (correction(raw.sigmoid()[point], seen) - shown).square().mean() + correction.penalty()
        loss.backward()
        optimizer.step()
    found = correction.stops.detach()[trained]
    assert float(found.mean(dim=0).abs().max()) < 1e-3
    for number in range(3):
        assert float(torch.corrcoef(torch.stack([found[:, number], stops[:, number]]))[0, 1]) > 0.99
    assert float((raw.detach().sigmoid() - colors).abs().mean()) < 0.01
