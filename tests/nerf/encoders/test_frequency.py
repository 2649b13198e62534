import math

import torch
from torch.autograd import gradcheck

from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder


def test_it_is_the_articles_encoding_written_as_a_loop():
    points = torch.rand(4, 3, dtype=torch.float64)
    expected = [points]
    for number in range(5):
        expected += [torch.sin(2.0**number * points), torch.cos(2.0**number * points)]
    torch.testing.assert_close(FrequencyEncoder(5).double()(points), torch.cat(expected, dim=-1))


def test_with_pi_the_lowest_frequency_has_period_two():
    encoder = FrequencyEncoder(3, include_input=False, with_pi=True).double()
    points = torch.rand(5, 3, dtype=torch.float64)
    # The frequencies themselves are kept in float32.
    close = {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(encoder(points + 2.0), encoder(points), **close)
    without = FrequencyEncoder(3, include_input=False).double()
    torch.testing.assert_close(without(points + 2 * math.pi), without(points), **close)
    torch.testing.assert_close(encoder(points), without(math.pi * points), **close)


def test_gradcheck():
    assert gradcheck(FrequencyEncoder(3).double(), (torch.rand(2, 3, dtype=torch.float64, requires_grad=True),))
