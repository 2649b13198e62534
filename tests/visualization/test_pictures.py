import os
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.visualization.figures import epoch_figure, loss_curve
from nerf_lightning.visualization.pictures import (
    ERROR_SCALE,
    color_map,
    depth_picture,
    error_picture,
    joint_range,
    mosaic,
    panels,
    save_png,
    side_by_side,
    to_bytes,
    visible_range,
)


def test_bytes_are_clamped_and_rounded_and_every_byte_survives_the_way_through_floats():
    rgb = torch.tensor([[[-0.2, 0.0, 0.499 / 255], [0.501 / 255, 1.0, 1.7]]])
    assert to_bytes(rgb).tolist() == [[[0, 0, 0], [1, 255, 255]]]
    steps = torch.arange(256).repeat(3, 1).T
    assert torch.equal(to_bytes(steps / 255), steps.to(torch.uint8))
    assert to_bytes(torch.full((1, 3), float("nan"))).tolist() == [[0, 0, 0]]


def test_a_saved_picture_reads_back_equal_and_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    picture = torch.randint(0, 256, (5, 7, 3), dtype=torch.uint8)
    path = tmp_path / "deep" / "er" / "a.png"
    save_png(path, picture)
    assert np.array_equal(np.asarray(Image.open(path)), picture.numpy())
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]
    before = path.read_bytes()

    def full_disk(self, target, format):
        target.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_png(path, torch.ones(2, 2, 3, dtype=torch.uint8))
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["a.png"]


def test_colors_grow_brighter_from_low_to_high_and_outside_the_range_are_its_ends():
    ramp = color_map(torch.linspace(2, 6, 64)[None], 2.0, 6.0)[0]
    luma = ramp @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luma.diff() > 0).all()
    assert luma[0] < 0.05
    assert luma[-1] > 0.9
    reversed_ramp = color_map(torch.linspace(2, 6, 64)[None], 6.0, 2.0)[0]
    torch.testing.assert_close(reversed_ramp, ramp.flip(0))
    low, high, inside_out = float("-inf"), float("inf"), float("nan")
    ends = color_map(torch.tensor([[low, 0.0, inside_out, 1.0, 9.0, high]]), 0.0, 1.0)[0]
    assert torch.equal(ends[0], ends[1])
    assert torch.equal(ends[2], ends[1])
    assert torch.equal(ends[3], ends[4])
    assert torch.equal(ends[3], ends[5])
    assert color_map(torch.full((1, 1), 3.0), 3.0, 3.0).isfinite().all()


def test_side_by_side_keeps_the_pixels_and_whitens_the_gap():
    one, two = torch.full((4, 3, 3), 10, dtype=torch.uint8), torch.full((2, 5, 3), 20, dtype=torch.uint8)
    row = side_by_side([one, two], gap=2)
    assert row.shape == (4, 10, 3)
    assert (row[:, :3] == 10).all()
    assert (row[:, 3:5] == 255).all()
    assert (row[2:, 5:] == 20).all()
    assert (row[:2, 5:] == 255).all()


def test_visible_range_ignores_what_light_passes_through():
    depth = torch.linspace(2, 4, 100).reshape(10, 10)
    depth[0], depth[-1] = 100.0, float("inf")
    opacity = torch.ones(10, 10)
    opacity[0] = 0.1
    near, far = visible_range(depth, opacity)
    assert 2.2 <= near < 2.3
    assert 3.7 < far <= 3.8
    assert visible_range(depth, torch.zeros(10, 10))[1] > 50
    assert joint_range([(depth[:5], opacity[:5]), (depth[5:], opacity[5:])]) == (near, far)


@pytest.mark.parametrize("size", [24, 301])
def test_the_depth_picture_keeps_the_pixels_left_of_its_scale(size):
    depth = torch.linspace(2, 6, size).expand(size, size)
    picture = depth_picture(depth, 2.0, 6.0)
    expected = to_bytes(color_map(depth, 6.0, 2.0))
    assert torch.equal(picture[:, :size], expected)
    assert picture.shape[0] == size
    assert picture.shape[1] < 1.25 * size + 40
    # The bar runs from near (bright) on top to far.
    bar = picture[:, size + max(3, max(10, round(0.03 * size)) // 3) + 1].float().mean(dim=-1)
    assert bar[0] > 200
    assert bar[-1] < 10


def test_a_scale_inside_a_picture_keeps_its_size_and_leaves_out_what_has_no_room():
    depth = torch.linspace(2, 6, 301).expand(301, 301)
    plain, scaled = to_bytes(color_map(depth, 6.0, 2.0)), depth_picture(depth, 2.0, 6.0, scale_inside=True)
    changed = (plain != scaled).any(dim=-1)
    assert scaled.shape == plain.shape
    assert changed.any()
    assert not changed[40:].any()  # players have their controls below
    assert not changed[:, :250].any()
    small = depth[:20, :30]
    assert torch.equal(depth_picture(small, 2.0, 6.0, scale_inside=True), to_bytes(color_map(small, 6.0, 2.0)))


def test_depth_fades_to_grey_where_nothing_is_and_error_has_a_fixed_scale():
    opacity = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    picture = depth_picture(torch.full((2, 2), 6.0), 2.0, 6.0, opacity)
    assert picture[0, 1].tolist() == [237, 237, 237]
    assert picture[0, 0].max() < 10
    truth = torch.zeros(30, 30, 3)
    render = truth.clone()
    render[:, 10:20] = ERROR_SCALE
    render[:, 20:] = -2 * ERROR_SCALE
    picture = error_picture(truth, render)
    ends = to_bytes(color_map(torch.tensor([[0.0, 1.0]]), 0.0, 1.0))[0]
    assert torch.equal(picture[0, 0], ends[0])
    assert torch.equal(picture[0, 15], ends[1])
    assert torch.equal(picture[0, 25], ends[1])


@pytest.mark.parametrize("size", [8, 200])
def test_the_mosaic_shows_truth_and_render_unscaled(size):
    truth, render = torch.rand(size, size, 3), torch.rand(size, size, 3)
    picture = mosaic(panels(truth, render, torch.rand(size, size) + 2, torch.ones(size, size)))
    corner = max(10, round(0.03 * size)) // 2
    top = picture.shape[0] - corner - size
    assert torch.equal(picture[top : top + size, corner : corner + size], to_bytes(truth))
    squares = picture[top : top + size].unfold(1, size, 1).permute(1, 0, 3, 2)  # at every column of the row
    assert any(torch.equal(square, to_bytes(render)) for square in squares)
    assert (picture[:corner] == 255).all()
    assert (picture[:top] < 255).any(), "captions"


def ink(picture):
    return float((picture.float().mean(dim=-1) < 200).float().mean())


def test_the_axis_is_logarithmic_and_awkward_values_draw_without_a_warning():
    # An exponential decay is a straight line there: blue pixels lie about the diagonal.
    picture = loss_curve(range(200), [10 ** (-i / 50) for i in range(200)], width=400, height=400).float()
    rows, columns = torch.where((picture[..., 2] - picture[..., 0]) > 60)
    line = torch.stack([rows, columns]).double()
    assert torch.corrcoef(line)[0, 1] > 0.999
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
