"""Broken transforms.json: one paragraph that says where, what, and the cure; never another exception."""

import numpy as np
import pytest
from PIL import Image
from support.malformed import Cases, edit_frame, edit_json, refused_when_damaged
from support.posed_captures import Known, frames_of

case = Cases()


@case("transforms", r"transforms.json does not exist; the folder holds images. Point scene.root")
def no_json(root):
    (root / "transforms.json").unlink()


@case("transforms", r"but transforms_train.json does: this is the Blender format. Use scene=blender scene.root=")
def the_blender_format(root):
    (root / "transforms.json").rename(root / "transforms_train.json")


@case("transforms", r"transforms.json is not valid json: .* at line 1, column \d+. Export it again")
def json_cut_short(root):
    path = root / "transforms.json"
    path.write_text(path.read_text()[:-20])


@case("transforms", r"transforms.json nests its brackets too deeply")
def json_of_brackets(root):
    (root / "transforms.json").write_text("[" * 100_000)


@case("transforms", r"transforms.json is not usable json: .*digits")
def a_number_of_ten_thousand_digits(root):
    (root / "transforms.json").write_text('{"fl_x": 1' + "0" * 10_000 + "}")


@case("transforms", r"transforms.json: frames\[0\] .*: fl_x has too many digits")
def a_number_of_a_thousand_digits(root):
    edit_json(root, lambda content: content | {"fl_x": 10**1000})


@case("transforms", r"frames\[0\] .*transform_matrix is not a 4 x 4 matrix of numbers")
def a_pose_of_a_thousand_digits(root):
    edit_frame(root, 0, transform_matrix=[[10**400] * 4] * 4)


@case("transforms", r"has the focal length 1e-300, .*; all must be above 0, and a focal length at least 0.001")
def a_focal_length_of_nothing(root):
    edit_json(root, lambda content: content | {"fl_x": 1e-300, "fl_y": 1e-300})


@case("transforms", r"transform_matrix lies beyond 1e\+09, where no digit is left")
def a_camera_at_the_end_of_the_world(root):
    edit_frame(root, 0, transform_matrix=[[1, 0, 0, 9e30], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@case("transforms", r"poses.csv is not valid json: .*line 1", file="poses.csv")
def a_csv_of_reality_capture(root):
    (root / "poses.csv").write_text("#name,x,y,alt,heading,pitch,roll\np_0.png,0,0,1,2,3,4\n")


@case("transforms", r"lacks frames; it has camera_type, render_height, camera_path, fps. A transforms.json of")
def a_camera_path_of_nerfstudio(root):
    edit_json(root, lambda _: {"camera_type": "perspective", "render_height": 9, "camera_path": [], "fps": 24})


@case("transforms", r"transforms.json lacks frames; it has camera_angle_x")
def json_without_frames(root):
    edit_json(root, lambda _: {"camera_angle_x": 0.7})


@case("transforms", r"transforms.json must be a json object with the keys frames, but it is list")
def json_that_is_a_list(root):
    edit_json(root, lambda content: content["frames"])


@case("transforms", r"frames must be a list of views, but it is dict")
def frames_by_name(root):
    edit_json(root, lambda content: content | {"frames": {"a": 1}})


@case("transforms", r"transforms.json lists no views")
def no_frames(root):
    edit_json(root, lambda content: content | {"frames": []})


@case("transforms", r"frames\[0\] lacks transform_matrix; it has file_path, pose")
def frames_of_another_tool(root):
    edit_json(root, lambda content: content | {"frames": [{"file_path": "a.png", "pose": [1, 2, 3]}]})


@case("transforms", r"frames\[2\]: file_path is C:\\Users\\ann\\a.jpg, an absolute path of another machine. .*relative")
def an_absolute_path_of_windows(root):
    edit_frame(root, 2, file_path="C:\\Users\\ann\\a.jpg")


@case("transforms", r"frames\[2\]: file_path is /home/ann/a.jpg, an absolute path of another machine")
def an_absolute_path(root):
    edit_frame(root, 2, file_path="/home/ann/a.jpg")


@case("transforms", r"frames\[2\]: the image \S+images/no.png does not exist .*Copy it there, or remove its frame")
def an_image_that_is_not_there(root):
    edit_frame(root, 2, file_path="images/no.png")


@case("transforms", r"frames\[2\]: the image .* does not exist")
def an_image_name_longer_than_names_can_be(root):
    edit_frame(root, 2, file_path="images/" + "x" * 5000)


@case("transforms", r"frames\[2\]: file_path is 7, but it must be the image's path as text")
def an_image_by_number(root):
    edit_frame(root, 2, file_path=7)


@case("transforms", r"frames\[2\] .*transform_matrix is not a camera pose: .* not transposed")
def a_transposed_pose(root):
    rows = np.array(frames_of(Known())[2]["transform_matrix"])
    edit_frame(root, 2, transform_matrix=rows.T.tolist())


@case("transforms", r"frames\[2\] .*transform_matrix holds NaN or infinite numbers")
def a_pose_with_nan(root):
    edit_frame(root, 2, transform_matrix=[[float("nan")] * 4] * 4)


@case("transforms", r"transforms.json lists images/p_1.png more than once. Remove all but one of each")
def a_frame_twice(root):
    edit_frame(root, 2, file_path="./images/p_1.png")


@case("transforms", r"the view images/p_0.png has the focal length 0, 20")
def fl_x_of_zero(root):
    edit_json(root, lambda content: content | {"fl_x": 0.0})


@case("transforms", r"the view images/p_0.png has a pose or intrinsics with NaN or infinity")
def intrinsics_with_nan(root):
    edit_json(root, lambda content: content | {"cx": float("nan")})


@case("transforms", r"frames\[0\] .*: fl_x is '20', but it must be a number")
def numbers_as_text(root):
    edit_json(root, lambda content: content | {"fl_x": "20"})


@case("transforms", r"frames\[0\] .*: h is None, but it must be a number")
def a_width_without_a_height(root):
    edit_json(root, lambda content: {key: value for key, value in content.items() if key != "h"})


@case("transforms", r"frames\[0\] .* has no focal length: neither fl_x \(pixels\) nor camera_angle_x \(radians\)")
def no_focal_length(root):
    edit_json(root, lambda content: {key: value for key, value in content.items() if not key.startswith("fl_")})


@case("transforms", r"camera_angle_x is 45.0, but it must lie between 0 and pi radians")
def an_angle_in_degrees(root):
    edit_json(root, lambda content: {"camera_angle_x": 45.0, "frames": content["frames"]})


@case("transforms", r"p_1.heic is a photograph in the format HEIC. .* Convert all of them to JPEG")
def a_photograph_as_phones_save_it(root):
    edit_frame(root, 1, file_path="images/p_1.heic")
    (root / "images" / "p_1.heic").write_bytes(b"\0\0\0\x18ftypheic" + 100 * b"\0")


@case("transforms", r"scene.masks_keep=black, and no photograph of .* has a mask. Say where", masks_keep="black")
def inverted_masks_that_are_not_there(root):
    pass


@case("transforms", r"has the camera_model 'VR180_L'; known are PINHOLE, .* export them as perspective")
def half_a_panorama(root):
    edit_json(root, lambda content: content | {"camera_model": "VR180_L"})


@case("transforms", r"is a panorama \(EQUIRECTANGULAR\) with fl_x=5 and fl_y=12 for 16 x 12 pixels, .* remove both")
def a_panorama_that_goes_around_more_than_once(root):
    edit_json(root, lambda content: content | {"camera_model": "EQUIRECTANGULAR", "fl_x": 5.0, "fl_y": 12.0})


@case("transforms", r"has the camera_model EQUIRECTANGULAR and distortion coefficients. Remove the one or the other")
def a_panorama_with_distortion(root):
    edit_json(root, lambda content: content | {"camera_model": "EQUIRECTANGULAR", "k1": 0.1})


@case("transforms", r"mixes panoramas \(EQUIRECTANGULAR\) with others, and a scene has one kind. Split the capture")
def a_panorama_among_other_photographs(root):
    edit_frame(root, 1, camera_model="EQUIRECTANGULAR", fl_x=8.0, fl_y=12.0)


@case("transforms", r"has the camera_model \['OPENCV'\]; known are")
def a_list_of_camera_models(root):
    edit_json(root, lambda content: content | {"camera_model": ["OPENCV"]})


@case("transforms", r"has the camera_model PINHOLE and distortion coefficients. Remove the one or the other")
def a_pinhole_with_distortion(root):
    edit_json(root, lambda content: content | {"camera_model": "PINHOLE", "k1": 0.1})


@case("transforms", r"transforms.json mixes fisheye lenses with others")
def a_fisheye_among_others(root):
    edit_frame(root, 1, camera_model="OPENCV_FISHEYE", k1=0.1)


@case("transforms", r"The lens of images/p_0.png .*has tangential coefficients p1, p2, which the model fisheye")
def a_fisheye_with_tangential_coefficients(root):
    edit_json(root, lambda content: content | {"camera_model": "OPENCV_FISHEYE", "p1": 0.1})


@case("transforms", r"frames\[1\] .*: mask_path is 3, but it must be the mask's path as text")
def a_mask_by_number(root):
    edit_frame(root, 1, mask_path=3)


@case("transforms", r"frames\[1\] .*: the mask \S+masks/a.png does not exist. Copy it there, or remove mask_path")
def a_mask_that_is_not_there(root):
    edit_frame(root, 1, mask_path="masks/a.png")


@case("transforms", r"The mask \S+m.png has 4 x 4 pixels, but its photograph \S+p_1.png has 16 x 12")
def a_mask_of_another_size(root):
    Image.new("L", (4, 4), 255).save(root / "m.png")
    edit_frame(root, 1, mask_path="m.png")


@case("transforms", r"scene.masks=masks holds no mask for images/p_1.png: neither .* exists. Add it", masks="masks")
def a_folder_that_lacks_a_mask(root):
    (root / "masks" / "images").mkdir(parents=True)
    Image.new("L", (16, 12), 255).save(root / "masks" / "images" / "p_0.png")


@case("transforms", r"train_filenames lists images/none.png, which no frame has. Mend the list")
def a_split_of_what_is_not_there(root):
    edit_json(root, lambda content: content | {"train_filenames": ["images/none.png"]})


@case("transforms", r"train_filenames must be a list of file names. Mend it, or remove it")
def a_split_that_is_text(root):
    edit_json(root, lambda content: content | {"train_filenames": "images/p_0.png"})


@case("transforms", r"splits its views into 2 to learn from and 0 to judge by; each needs at least one. Mend its lists")
def nothing_held_out(root):
    edit_json(root, lambda content: content | {"train_filenames": ["images/p_0.png", "images/p_1.png"]})


@case("transforms", r"applied_transform must be a matrix of 3 x 4 numbers that turns, moves and scales alike")
def an_applied_transform_that_shears(root):
    edit_json(root, lambda content: content | {"applied_transform": [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]})


@case("transforms", r"applied_transform must be a matrix")
def an_applied_transform_that_mirrors(root):
    edit_json(root, lambda content: content | {"applied_transform": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]})


@case("transforms", r"applied_transform must be a matrix")
def an_applied_transform_of_words(root):
    edit_json(root, lambda content: content | {"applied_transform": "none"})


@case("transforms", r"applied_scale is 0, but it must be above 0")
def an_applied_scale_of_zero(root):
    edit_json(root, lambda content: content | {"applied_scale": 0.0})


@pytest.mark.parametrize(("kind", "damage", "message", "settings"), case.params)
def test_it_is_refused_in_one_paragraph(tmp_path, kind, damage, message, settings):
    refused_when_damaged(tmp_path, kind, damage, message, settings)
