"""Attempts at cameras: more pains while photographs are left out, and the one that places most counts."""

from pathlib import Path

import pytest

from nerf_lightning.data.sfm import find_cameras as module
from nerf_lightning.data.sfm.find_cameras import find_cameras
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.data.sfm.reconstruction import NothingFoundError
from nerf_lightning.data.sfm.settings import SfmSettings, attempts

PHOTOGRAPHS = [FoundPhotograph(Path(f"{number}.jpg"), 96, 80, True, False, ()) for number in range(8)]


class Model:
    """What COLMAP found: the first photographs."""

    def __init__(self, placed, error=0.5, first=0):
        self.names, self.error = [f"{number}.jpg" for number in range(first, first + placed)], error

    def num_reg_images(self):
        return len(self.names)

    def compute_mean_reprojection_error(self):
        return self.error

    def reg_image_ids(self):
        return range(len(self.names))

    def image(self, number):
        return Photograph(self.names[number])

    def num_points3D(self):
        return 10

    def num_cameras(self):
        return 1

    def write_binary(self, folder):
        (Path(folder) / "cameras.bin").write_text(",".join(self.names))


class Photograph:
    def __init__(self, name):
        self.name = name


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
    model, made = find([[Model(8)]])
    assert (len(model.registered), made) == (8, 1)
    assert (tmp_path / "sparse" / "cameras.bin").is_file()


def test_the_attempt_that_places_most_counts(find, tmp_path, caplog):
    caplog.set_level("INFO")
    model, made = find([[Model(5)], [Model(7)], [Model(6)], [Model(7)]])
    assert (model.registered[-1], model.left_out, made) == ("6.jpg", ("7.jpg",), 4)
    assert (tmp_path / "sparse" / "cameras.bin").read_text().count(",") == 6
    assert "cameras: 5 of 8 placed; next try: all cameras placed at once" in caplog.text
    assert "cameras: 7 of 8 placed; next try: 8192 round features" in caplog.text


def test_one_that_fits_badly_does_not_count(find):
    model, _ = find([[Model(5)], [Model(8, error=3.0)], [Model(7, error=0.7)], []])
    assert len(model.registered) == 7


def test_nothing_found_at_first_may_be_found_later(find):
    model, made = find([[], [], [Model(8), Model(3, first=5)]])
    assert (len(model.registered), made) == (8, 3)
    with pytest.raises(NothingFoundError, match="No camera could be placed: the 8 pictures"):
        find([[], [], [], []])


def test_a_number_of_features_that_is_typed_is_all_that_is_tried(find):
    model, made = find([[Model(3), Model(3, first=4)]], num_features=600)
    assert made == 1
    assert model.apart == ("4.jpg", "5.jpg", "6.jpg")


@pytest.mark.parametrize(("count", "features", "tries"), [(16, 8192, 4), (50, 2048, 4), (300, 2048, 2)])
def test_many_photographs_begin_with_fewer_features(count, features, tries):
    tried = attempts(SfmSettings(), count)
    assert (tried[0].num_features, len(tried)) == (features, tries)
    assert len({attempt.database for attempt in tried}) == tries // 2
