"""Attempts at cameras: more pains while photographs are left out, and the one that places most counts."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from nerf_lightning.data.sfm import find_cameras as module
from nerf_lightning.data.sfm.find_cameras import find_cameras
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.data.sfm.reconstruction import NothingFoundError
from nerf_lightning.data.sfm.settings import SfmSettings, attempts

PHOTOGRAPHS = [FoundPhotograph(Path(f"{number}.jpg"), 96, 80, True, False, ()) for number in range(8)]


def model_of(placed, error=0.5, first=0):
    """What COLMAP found: the photographs from the first one on."""
    names = [f"{number}.jpg" for number in range(first, first + placed)]
    return SimpleNamespace(
        num_reg_images=lambda: placed,
        compute_mean_reprojection_error=lambda: error,
        reg_image_ids=lambda: range(placed),
        image=lambda number: SimpleNamespace(name=names[number]),
        num_points3D=lambda: 10,
        num_cameras=lambda: 1,
        write_binary=lambda folder: (Path(folder) / "cameras.bin").write_text(",".join(names)),
    )


@pytest.fixture
def find(monkeypatch, tmp_path):
    """Find cameras where each attempt finds what is given; returns what is said and how many were made."""

    def found(results, **settings):
        made = []

        def reconstruct(photographs, folder, work, settings, attempt, report):
            made.append(attempt)
            return results[len(made) - 1]

        monkeypatch.setattr(module, "reconstruct", reconstruct)
        return find_cameras(PHOTOGRAPHS, tmp_path, tmp_path, tmp_path / "sparse", SfmSettings(**settings)), len(made)

    return found


def test_nothing_more_is_tried_once_all_are_placed(find, tmp_path):
    model, made = find([[model_of(8)]])
    assert (len(model.registered), made) == (8, 1)
    assert (tmp_path / "sparse" / "cameras.bin").is_file()


def test_the_attempt_that_places_most_counts(find, tmp_path, caplog):
    caplog.set_level("INFO")
    model, made = find([[model_of(5)], [model_of(7)], [model_of(6)], [model_of(7)]])
    assert (model.registered[-1], model.left_out, made) == ("6.jpg", ("7.jpg",), 4)
    assert (tmp_path / "sparse" / "cameras.bin").read_text().count(",") == 6
    assert "cameras: 5 of 8 placed; next try: all cameras placed at once" in caplog.text
    assert "cameras: 7 of 8 placed; next try: 8192 round features" in caplog.text


def test_one_that_fits_badly_does_not_count(find):
    model, _ = find([[model_of(5)], [model_of(8, error=3.0)], [model_of(7, error=0.7)], []])
    assert len(model.registered) == 7


def test_nothing_found_at_first_may_be_found_later(find):
    model, made = find([[], [], [model_of(8), model_of(3, first=5)]])
    assert (len(model.registered), made) == (8, 3)
    with pytest.raises(NothingFoundError, match="No camera could be placed: the 8 pictures"):
        find([[], [], [], []])


def test_a_number_of_features_that_is_typed_is_all_that_is_tried(find):
    model, made = find([[model_of(3), model_of(3, first=4)]], num_features=600)
    assert made == 1
    assert model.disconnected == ("4.jpg", "5.jpg", "6.jpg")


@pytest.mark.parametrize(("count", "features", "tries"), [(16, 8192, 4), (50, 2048, 4), (300, 2048, 2)])
def test_many_photographs_begin_with_fewer_features(count, features, tries):
    tried = attempts(SfmSettings(), count)
    assert (tried[0].num_features, len(tried)) == (features, tries)
    assert len({attempt.database for attempt in tried}) == tries // 2
