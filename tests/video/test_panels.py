"""What a film's frames are put together of."""

import numpy as np
import torch

from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.video.panels import film_pictures, panel
from nerf_lightning.visualization.pictures import letter_size

RGB = torch.linspace(0, 1, 20 * 30 * 3).view(20, 30, 3)
OPACITY = torch.ones(20, 30).index_fill(1, torch.arange(15), 0.0)
PICTURE = Picture(RGB, torch.full((20, 30), 2.0), OPACITY, first_rgb=RGB.flip(0))


def shown(output, normals=None):
    return panel(output, PICTURE, (1.0, 3.0), 1.0, normals)


def test_each_output_shows_what_it_says():
    assert torch.equal(shown("rgb"), (RGB * 255).round().to(torch.uint8))
    assert shown("opacity")[0, 0].tolist() == [0, 0, 0]
    assert shown("opacity")[0, 29].tolist() == [255, 255, 255]
    up = torch.tensor([0.0, 0.0, 1.0]).expand(20, 30, 3)
    assert shown("normals", up)[0, 29].tolist() == [128, 128, 255]
    left = shown("normals", up)[0, 0].tolist()
    assert left == [left[0]] * 3, "grey where nothing is"
    same = panel("levels", Picture(RGB, PICTURE.depth, OPACITY, first_rgb=RGB), (1.0, 3.0), 1.0, None)
    assert len(same[:, :30].reshape(-1, 3).unique(dim=0)) == 1
    assert len(shown("levels")[:, :30].reshape(-1, 3).unique(dim=0)) > 1


def test_depth_is_told_in_the_users_units():
    near = panel("depth", PICTURE, (4.0, 6.0), 2.0, None)  # 2 scene units are 4 of the user's: as near as can be
    far = panel("depth", PICTURE, (2.0, 4.0), 2.0, None)
    assert int(near[0, 29].sum()) > 600 > 100 > int(far[0, 29].sum())


def test_one_model_has_a_film_for_each_output_unchanged():
    films = film_pictures([{"rgb": shown("rgb"), "opacity": shown("opacity")}], [""], mosaic=False)
    assert list(films) == ["video", "opacity"]
    assert torch.equal(films["video"], shown("rgb"))


def test_several_models_stand_side_by_side_under_their_names():
    panels = [{"rgb": shown("rgb")}, {"rgb": shown("rgb").flip(0)}]
    film = film_pictures(panels, ["a", "b"], mosaic=False)["video"]
    size = letter_size(20)
    top, edge = size // 2 + round(1.5 * size), size // 2
    assert torch.equal(film[top : top + 20, edge : edge + 30], shown("rgb"))
    assert torch.equal(film[top : top + 20, edge + 30 + size : edge + 60 + size], shown("rgb").flip(0))
    other = film_pictures(panels, ["a", "other"], mosaic=False)["video"]
    assert not np.array_equal(film[:top], other[:top])


def test_a_mosaic_has_a_column_for_each_output_and_a_row_for_each_model():
    panels = [{"rgb": shown("rgb"), "depth": shown("depth"), "opacity": shown("opacity")}] * 2
    one, two = film_pictures(panels[:1], ["a"], mosaic=True), film_pictures(panels, ["a", "b"], mosaic=True)
    assert list(one) == list(two) == ["mosaic"]
    assert one["mosaic"].shape[1] > 3 * 30
    assert two["mosaic"].shape[0] > 2 * (one["mosaic"].shape[0] - 2 * letter_size(20))
