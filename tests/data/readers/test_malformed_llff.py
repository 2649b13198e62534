"""Broken LLFF captures: one paragraph that says where, what, and the cure; never another exception."""

import numpy as np
import pytest
from support.malformed import Cases, edit_rows, one_picture, refused_when_damaged
from support.posed_captures import write_pictures

case = Cases()


@case("llff", r"The folder .*capture does not exist. Set scene.root")
def no_folder(root):
    root.rename(root.parent / "elsewhere")


@case("llff", r"poses_bounds.npy does not exist; the folder holds images\. Point scene.root")
def no_poses(root):
    (root / "poses_bounds.npy").unlink()


@case("llff", r"poses_bounds.npy is not an array of numbers as numpy saves it .*imgs2poses.*scene=colmap")
def poses_cut_short(root):
    path = root / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:-9])


@case("llff", r"poses_bounds.npy is not an array of numbers as numpy saves it")
def poses_cut_in_the_header(root):
    (root / "poses_bounds.npy").write_bytes((root / "poses_bounds.npy").read_bytes()[:40])


@case("llff", r"poses_bounds.npy is not an array of numbers as numpy saves it")
def poses_empty(root):
    (root / "poses_bounds.npy").write_bytes(b"")


@case("llff", r"poses_bounds.npy is not an array of numbers as numpy saves it")
def poses_are_an_archive(root):
    with (root / "poses_bounds.npy").open("wb") as file:
        np.savez(file, poses=np.zeros((9, 17)))


@case("llff", r"poses_bounds.npy is not an array of numbers .*Object arrays cannot be loaded")
def poses_are_pickled(root):
    np.save(root / "poses_bounds.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)


@case("llff", r"poses_bounds.npy is 9 x 15 of float64, but each view needs one row of 17 numbers")
def poses_without_bounds(root):
    edit_rows(root, lambda rows: rows[:, :15])


@case("llff", r"is 9 x 14 of float64, but each view needs one row of 17")
def poses_of_the_new_llff_width(root):
    edit_rows(root, lambda rows: rows[:, :14])


@case("llff", r"is 9 x 17 of complex128, but each view needs")
def poses_are_complex(root):
    edit_rows(root, lambda rows: rows + 1j)


@case("llff", r"is a single number of float64, but each view needs")
def poses_are_a_number(root):
    edit_rows(root, lambda rows: np.array(3.0))


@case("llff", r"poses_bounds.npy lists no views|has 0 poses, but \S+images has 9 photographs")
def poses_of_nothing(root):
    edit_rows(root, lambda rows: rows[:0])


@case("llff", r"has 9 poses, but \S+images has 8 photographs, and they belong together in order of names. Remove")
def a_photograph_is_missing(root):
    one_picture(root).unlink()


@case("llff", r"has 9 poses, but \S+images has 10 photographs")
def a_photograph_too_many(root):
    write_pictures(root / "images", ("extra.png",), (16, 12))


@case("llff", r"holds NaN or infinity in row 2, 5 \(counted from 0\)")
def poses_with_nan(root):
    def change(rows):
        rows[2, 3], rows[5, 16] = np.nan, np.inf
        return rows

    edit_rows(root, change)


@case("llff", r"row 4 \(counted from 0\) does not have 0 < near < far in its end")
def bounds_the_wrong_way_round(root):
    def change(rows):
        rows[4, 15:] = rows[4, :14:-1]
        return rows

    edit_rows(root, change)


@case("llff", r"poses_bounds.npy: the view p_0.png has the focal length 0, 0 for 16 x 12 pixels; all must be above 0")
def a_focal_length_of_zero(root):
    edit_rows(root, lambda rows: np.where(np.arange(17) == 14, 0.0, rows))


@case("llff", r"the view p_0.png has the focal length -20, -20")
def a_negative_focal_length(root):
    edit_rows(root, lambda rows: np.where(np.arange(17) == 14, -rows, rows))


@case("llff", r"the view p_0.png has a pose that is not a rotation and a centre \(it scales, mirrors or shears\)")
def mirrored_poses(root):
    edit_rows(root, lambda rows: np.where(np.isin(np.arange(17), [0, 5, 10]), -rows, rows))


@case("llff", r"p_0.png has 16 x 12 pixels, but its camera was calibrated for 12 x 16: .* cropped, turned or stretched")
def height_and_width_exchanged(root):
    def change(rows):
        rows[:, [4, 9]] = rows[:, [9, 4]]
        return rows

    edit_rows(root, change)


@case("llff", r"has no folder images or images_2 or images_4 or images_8 with the photographs. Set scene.images")
def no_folder_of_photographs(root):
    (root / "images").rename(root / "pictures")


@case("llff", r"has no folder images_16 with the photographs", images="images_16")
def the_wrong_folder_of_photographs(root):
    pass


@case("llff", r"All 9 cameras of \S+poses_bounds.npy stand at one place, and .* Photograph from several")
def a_tripod_that_only_turned(root):
    def change(rows):
        rows[:, [3, 8, 13]] = [1.0, 2.0, 3.0]
        return rows

    edit_rows(root, change)


@case("llff", r"Holding out views from 1 leaves 0 to learn from and 1 to judge by")
def one_view(root):
    edit_rows(root, lambda rows: rows[:1])
    for path in sorted((root / "images").iterdir())[1:]:
        path.unlink()


@pytest.mark.parametrize(("kind", "damage", "message", "settings"), case.params)
def test_it_is_refused_in_one_paragraph(tmp_path, kind, damage, message, settings):
    refused_when_damaged(tmp_path, kind, damage, message, settings)
