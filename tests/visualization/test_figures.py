import gc
import warnings

import torch

from nerf_lightning.visualization.figures import epoch_figure, loss_curve


def ink(picture):
    return float((picture.float().mean(dim=-1) < 200).float().mean())


def test_a_curve_has_the_size_that_was_asked_for():
    picture = loss_curve(range(100), [1.0 / (i + 1) for i in range(100)], width=320, height=200)
    assert picture.shape == (200, 320, 3)
    assert picture.dtype == torch.uint8
    assert 0.001 < ink(picture) < 0.2


def test_the_axis_is_logarithmic():
    # An exponential decay is a straight line there: blue pixels lie about the diagonal.
    picture = loss_curve(range(200), [10 ** (-i / 50) for i in range(200)], width=400, height=400).float()
    rows, columns = torch.where((picture[..., 2] - picture[..., 0]) > 60)
    line = torch.stack([rows, columns]).double()
    assert torch.corrcoef(line)[0, 1] > 0.999


def test_awkward_values_draw_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for values in ([], [0.1], [0.0, 0.0], [1.0, 0.0, float("nan"), float("inf"), 0.5], [float("nan")]):
            assert loss_curve(range(len(values)), values, width=200, height=150).shape == (150, 200, 3)


def test_the_epoch_shows_three_panels():
    render, depth = torch.zeros(20, 20, 3), torch.linspace(2, 6, 20).expand(20, 20)
    render[..., 0] = 1.0
    picture = epoch_figure(render, depth, range(10), [0.5**i for i in range(10)], height=200).float()
    assert picture.shape[0] == 200
    width = picture.shape[1]
    red = (picture[..., 0] > 240) & (picture[..., 1] < 20)
    assert red[:, : width // 3].float().mean() > 0.3
    assert not red[:, width // 2 :].any()
    middle = picture[:, width // 3 : 2 * width // 3]
    assert len(torch.unique(middle.reshape(-1, 3), dim=0)) > 20
    assert ink(picture[:, 2 * width // 3 :]) > 0.002


def test_nothing_global_stays_behind():
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    loss_curve([0, 1], [1.0, 0.5])
    gc.collect()
    assert pyplot.get_fignums() == []
    assert not [thing for thing in gc.get_objects() if type(thing) is Figure]
