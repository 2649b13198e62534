"""Formats of other programs give the cameras that were written, leave out what is broken, and are refused in words."""

import json
import re
import shutil
from functools import partial

import numpy as np
import pytest
from posed_writers import (
    BROWN,
    KNOWN,
    MIDDLE,
    NOW,
    SQUARE,
    VIEWS,
    as_text,
    c2w,
    dump,
    meshroom,
    opensfm,
    text,
    write_bundler,
    write_meshroom,
    write_mvsnet,
    write_nerfies,
    write_openmvg,
    write_opensfm,
    write_real_estate,
    write_replica,
    write_scanner_app,
    write_scannet,
    write_sdfstudio,
    write_seven_scenes,
    write_splat_cameras,
    write_stray,
    write_tanks,
    write_tum,
)
from support.plain_capture import everything_is_said, read, said_once  # noqa: F401

from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.extensions.other_formats.other_program import OtherProgramReader
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import is_rigid

NONE = (0.0,) * 6
GIVEN = [20.0, 21.0, 7.5, 6.25]
BROWN_LENS = (0.1, 0.2, 0.3, 0.0, 0.01, 0.02)
FORMATS = {
    "sdfstudio": (write_sdfstudio, KNOWN, NONE, "meta_data.json", '{"rgb_path": []}', "must have a list frames"),
    "meshroom": (write_meshroom, KNOWN, NONE, "cameras.sfm", '{"viewId": 1}', r"Meshroom .* must have a list views"),
    "openmvg": (
        write_openmvg,
        SQUARE,
        NONE,
        "sfm_data.json",
        '{"sfm_data_version": "0.3"}',
        "openMVG must have a list",
    ),
    "opensfm": (write_opensfm, KNOWN, NONE, "reconstruction.json", "[]", "OpenSfM or ODM holds no reconstruction"),
    "bundler": (
        write_bundler,
        MIDDLE,
        (0.1, -0.02, 0, 0, 0, 0),
        "bundle.out",
        "# Bundle file v0.3\n1 0\n",
        "ends early",
    ),
    "nerfies": (write_nerfies, KNOWN, BROWN_LENS, "dataset.json", '{"train_ids": []}', "must have a list ids"),
    "3dgs": (write_splat_cameras, MIDDLE, NONE, "cameras.json", '[{"img_name": 1}]', "img_name is 1"),
    "scannet": (
        write_scannet,
        KNOWN,
        NONE,
        "intrinsic/intrinsic_color.txt",
        "nothing",
        "does not begin with the numbers",
    ),
    "12-scenes": (write_seven_scenes, KNOWN, NONE, "info.txt", "x", "m_calibrationColorIntrinsic must be 16 numbers"),
    "mvsnet": (write_mvsnet, KNOWN, NONE, "cams/*.txt", "extrinsic 1 2", "does not hold the matrices"),
    "scanner app": (write_scanner_app, KNOWN, NONE, "frame_*.json", '{"cameraPoseARFrame": []}', "must be 16 numbers"),
    "replica": (
        write_replica,
        KNOWN,
        NONE,
        "cam_params.json",
        '{"camera": {}}',
        "cam_params.json: w must be a number, but it is missing",
    ),
    "real estate": (write_real_estate, KNOWN, NONE, "*.txt", "http://x\n" + "1 " * 18 + "x", "no capture in a known"),
    "stray scanner": (write_stray, KNOWN, NONE, "camera_matrix.csv", "1, 2", "camera_matrix.csv must be 9 numbers"),
}


def assert_known(capture, known, lens=NONE, focal=None):
    assert len(capture.views) == len(VIEWS)
    for number, view in enumerate(sorted(capture.views, key=lambda view: int(re.findall(r"\d+", view.name)[-1]))):
        np.testing.assert_allclose(view.c2w.numpy(), known.c2w[number], atol=1e-6)
        np.testing.assert_allclose(view.focal, focal or known.focal, atol=1e-6)
        np.testing.assert_allclose(view.center, known.center, atol=1e-6)
        np.testing.assert_allclose(view.lens, lens, atol=1e-6)
        assert view.size == known.size
    assert (capture.lens_model == "pinhole") == (not any(lens))


@pytest.fixture(params=FORMATS)
def case(request, tmp_path):
    write, known, *rest = FORMATS[request.param]
    write(tmp_path / "c", known)
    return tmp_path / "c", known, *rest


def test_the_cameras_are_those_that_were_written(case):
    root, known, lens, *_ = case
    capture = AutoReader(root=str(root)).capture()
    assert_known(capture, known, lens)
    assert bool(is_rigid(capture.undo[:3]))
    assert not len(capture.points) or capture.points.tolist() == [[0, 1, 2]]


def broken(root):
    """Break what belongs to the fourth picture: its entry where pictures may be absent, else the picture."""
    if (root / "traj.txt").exists():
        lines = (root / "traj.txt").read_text().splitlines()
        text(root / "traj.txt", [*lines[:3], "1 2 3", *lines[4:]])
    elif (root / "frame_00003.json").exists():
        dump(root / "frame_00003.json", {"cameraPoseARFrame": [1, 2]})
    else:
        paths = [path for path in root.rglob("*.png") if re.search(r"(^|\D)0*3(033)?(_rgb|\.color)?$", path.stem)]
        (path,) = paths
        path.unlink()


def test_what_is_broken_is_left_out_by_name(case):
    broken(case[0])
    capture = AutoReader(root=str(case[0])).capture()
    assert (len(capture.views), len(capture.left_out.faults)) == (8, 1)
    ((name, why),) = capture.left_out.faults.items()
    assert "3" in name
    assert re.search("no picture below|must be 16 numbers", why)


def test_a_wrong_file_is_refused_in_words(case):
    root, _, _, file, content, message = case
    for path in root.glob(file):
        path.write_text(content)
    with pytest.raises(InputError, match=message):
        read(root)


def at(write, **more):
    return partial(write, **more)


@pytest.mark.parametrize(
    ("write", "program"),
    [
        (write_tum, "TUM"),
        (write_tanks, "Tanks and Temples"),
        (at(write_seven_scenes, info=False), "7-Scenes"),
    ],
)
def test_intrinsics_that_a_format_lacks_are_asked_for_and_taken(tmp_path, write, program):
    write(tmp_path / "c", KNOWN)
    with pytest.raises(InputError, match=rf"{program} has poses without focal lengths. Give fx, fy, cx and cy"):
        read(tmp_path / "c")
    assert_known(OtherProgramReader(root=str(tmp_path / "c"), intrinsics=GIVEN).capture(), KNOWN)


def test_tums_pictures_without_a_pose_near_in_time_are_left_out(tmp_path):
    write_tum(tmp_path, KNOWN)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    text(tmp_path / "groundtruth.txt", [line for line in lines if not line.startswith("1305031105.01")])
    left_out = OtherProgramReader(root=str(tmp_path), intrinsics=GIVEN).capture().left_out
    assert list(left_out.faults) == ["rgb/3.png"]
    assert "no pose within 0.02 s" in left_out.faults["rgb/3.png"]


def test_poses_are_not_paired_with_another_number_of_pictures(tmp_path):
    write_tanks(tmp_path, KNOWN)
    (tmp_path / "images" / "000004.png").unlink()
    with pytest.raises(InputError, match=r"has 9 poses, but .* has 8 pictures"):
        OtherProgramReader(root=str(tmp_path), intrinsics=GIVEN).capture()


def test_depths_of_replica_and_phones_are_read_in_their_units(tmp_path):
    for write, unit, count in ((write_replica, 1 / 6553.5, 9), (write_stray, 1e-3, 1), (write_scanner_app, 1e-3, 1)):
        write(tmp_path / write.__name__, KNOWN)
        capture = AutoReader(root=str(tmp_path / write.__name__)).capture()
        assert capture.depth_unit == pytest.approx(unit)
        assert sum(view.depth is not None for view in capture.views) == count


def test_stray_scanners_later_versions_have_intrinsics_in_each_line(tmp_path, caplog):
    write_stray(tmp_path / "c", KNOWN, later=True)
    view = AutoReader(root=str(tmp_path / "c")).capture().views[4]
    assert (view.focal, view.center) == ((30, 31), (7, 6))
    said_once(caplog, "confidence of depths is not used")
    shutil.rmtree(tmp_path / "c" / "rgb")
    with pytest.raises(InputError, match=r"Stray Scanner holds a video and no pictures.*ffmpeg -i rgb\.mp4"):
        read(tmp_path / "c")


OLD = {"type": "radial3", "pxFocalLength": 20, "principalPoint": [7.5, 6.25], "distortionParams": [0.1, 0.2, 0.3]}
BROWN_T = {"distortionType": "brown", "distortionParams": [0.1, 0.2, 0.3, 0.01, 0.02]}
FISHEYE = {"distortionType": "fisheye4", "distortionParams": [0.1, 0.2, 0.3, 0.4]}


@pytest.mark.parametrize(
    ("version", "intrinsic", "known", "lens"),
    [
        ("1.0.0", OLD, SQUARE, (0.1, 0.2, 0.3, 0, 0, 0)),
        ("1.2.0", OLD | {"pxFocalLength": [20, 21], "type": "brown", "distortionParams": ""}, KNOWN, NONE),
        ("1.2.1", OLD | {"pxFocalLength": [20, 21], "principalPoint": [-0.5, 0.25]}, KNOWN, (0.1, 0.2, 0.3, 0, 0, 0)),
        ("1.2.4", NOW | {"pixelRatio": 20 / 21}, KNOWN, NONE),
        ("1.2.8", NOW | BROWN_T, KNOWN, BROWN_LENS),
        ("1.2.8", NOW | FISHEYE, KNOWN, (0.1, 0.2, 0.3, 0.4, 0, 0)),
    ],
)
def test_meshrooms_versions_count_in_other_units(tmp_path, version, intrinsic, known, lens):
    write_meshroom(tmp_path, known, intrinsic, version=version)
    assert_known(AutoReader(root=str(tmp_path)).capture(), known, lens)


def test_meshrooms_rigs_are_composed(tmp_path):
    """The second camera of a rig stands 1 to the right of the first, turned by a quarter around the view's axis."""
    write_meshroom(tmp_path, KNOWN)
    content = json.loads((tmp_path / "cameras.sfm").read_text())
    turn = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    place = {"rotation": np.array(turn).T.ravel().tolist(), "center": [1.0, 0.0, 0.0]}
    content |= as_text({"rigs": [{"rigId": 3, "subPoses": [{}, {"status": "estimated", "pose": place}]}]})
    content["views"][4] |= as_text({"rigId": 3, "subPoseId": 1, "isPoseIndependant": "false"})
    content["views"][5] |= as_text({"rigId": 3, "subPoseId": 2, "isPoseIndependant": "false"})
    content["views"][6]["poseId"] = "5"
    dump(tmp_path / "cameras.sfm", content)
    capture = AutoReader(root=str(tmp_path)).capture()
    view = next(view for view in capture.views if view.name.endswith("p_4.png"))
    # A point that the rig sees at x + 1 stands at turn @ (x, y, z) for the camera.
    second = np.eye(4)
    second[:3, :3], second[0, 3] = np.transpose(turn), 1.0
    true = c2w(KNOWN, 4) @ second
    np.testing.assert_allclose(view.c2w.numpy(), true[:3] * [1, -1, -1, 1], atol=1e-6)
    assert "its rig has 2 cameras" in capture.left_out.faults["/home/user/p_5.png"]
    assert capture.left_out.without_pose == ("/home/user/p_6.png",)


MVG = {
    "pinhole_radial_k1": ({"disto_k1": [0.1]}, (0.1, 0, 0, 0, 0, 0)),
    "pinhole_radial_k3": ({"disto_k3": [0.1, 0.2, 0.3]}, (0.1, 0.2, 0.3, 0, 0, 0)),
    "pinhole_brown_t2": ({"disto_t2": [0.1, 0.2, 0.3, 0.01, 0.02]}, BROWN_LENS),
    "fisheye": ({"fisheye": [0.1, 0.2, 0.3, 0.4]}, (0.1, 0.2, 0.3, 0.4, 0, 0)),
}


@pytest.mark.parametrize("kind", MVG)
def test_openmvgs_lenses(tmp_path, kind):
    data, lens = MVG[kind]
    write_openmvg(tmp_path, SQUARE, kind, data, nested=kind == "fisheye")
    capture = AutoReader(root=str(tmp_path)).capture()
    assert_known(capture, SQUARE, lens)
    assert capture.left_out.without_pose == ("unposed.png",)


@pytest.mark.parametrize(
    ("camera", "known", "lens"),
    [
        ({"projection_type": "perspective", "focal": 1.25, "k1": 0.1, "k2": 0.2}, MIDDLE, (0.1, 0.2, 0, 0, 0, 0)),
        (BROWN | {"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.01, "p2": 0.02}, KNOWN, BROWN_LENS),
        (BROWN | {"projection_type": "simple_radial", "k1": 0.1}, KNOWN, (0.1, 0, 0, 0, 0, 0)),
        ({"projection_type": "fisheye", "focal": 1.25, "k1": 0.1, "k2": 0.2}, MIDDLE, (0.1, 0.2, 0, 0, 0, 0)),
        (BROWN | {"projection_type": "fisheye_opencv", "k4": 0.4}, KNOWN, (0, 0, 0, 0.4, 0, 0)),
    ],
)
def test_opensfms_lenses(tmp_path, camera, known, lens):
    write_opensfm(tmp_path, known, camera)
    assert_known(AutoReader(root=str(tmp_path)).capture(), known, lens)


def test_panoramas_and_lenses_that_are_not_modeled(tmp_path):
    write_opensfm(tmp_path / "a", KNOWN, {"projection_type": "spherical"})
    capture = AutoReader(root=str(tmp_path / "a")).capture()
    assert capture.lens_model == "equirectangular"
    assert capture.views[0].focal == pytest.approx((16 / (2 * np.pi), 12 / np.pi))
    for name, write in {
        "dual": at(write_opensfm, camera={"projection_type": "dual", "focal": 1.0}),
        "pinhole_brown_t9": at(write_openmvg, kind="pinhole_brown_t9"),
        "3deanamorphic4": at(write_meshroom, intrinsic=NOW | {"distortionType": "3deanamorphic4"}),
    }.items():
        write(tmp_path / name, KNOWN)
        with pytest.raises(InputError, match=rf"{name}.* not supported .*Undistort"):
            read(tmp_path / name)


def test_an_odm_projects_reconstruction_is_that_of_the_photographs_that_are_there(tmp_path):
    write_opensfm(tmp_path, KNOWN, place="opensfm")
    plain = {"projection_type": "perspective", "focal": 2.0}
    write_opensfm(tmp_path, MIDDLE, plain, "opensfm/undistorted", "opensfm/undistorted/images")
    assert_known(AutoReader(root=str(tmp_path)).capture(), KNOWN)
    with pytest.raises(InputError, match=r"Give the folder .* which holds images and opensfm"):
        read(tmp_path / "opensfm" / "reconstruction.json")
    shutil.rmtree(tmp_path / "images")
    assert_known(AutoReader(root=str(tmp_path)).capture(), MIDDLE, focal=(32.0, 32.0))


def test_the_largest_reconstruction_of_opensfm_is_read(tmp_path, caplog):
    write_opensfm(tmp_path, KNOWN)
    part, whole = opensfm(MIDDLE), opensfm(KNOWN)
    part["shots"] = dict(list(part["shots"].items())[:2])
    dump(tmp_path / "reconstruction.json", [part, whole])
    assert_known(AutoReader(root=str(tmp_path)).capture(), KNOWN)
    said_once(caplog, r"of 2 reconstructions of 2, 9 photographs, .* the largest is read")


def test_nerfies_splits_bounds_and_time(tmp_path, caplog):
    write_nerfies(tmp_path, KNOWN)
    capture = AutoReader(root=str(tmp_path)).capture()
    assert capture.splits == {"train": (0, 1, 2, 3, 4, 5), "val": (6, 7, 8), "test": (6, 7, 8)}
    np.testing.assert_allclose(capture.bounds.numpy(), [[2.0, 9.0]] * 9)
    said_once(caplog, "time differs between pictures")


def test_bundlers_lists_may_name_focal_lengths_and_cameras_without_a_pose(tmp_path):
    write_bundler(tmp_path, MIDDLE, behind=" 0 532.5")
    capture = AutoReader(root=str(tmp_path)).capture()
    assert_known(capture, MIDDLE, (0.1, -0.02, 0, 0, 0, 0))
    assert capture.left_out.without_pose == ("images/unposed.png",)
    (tmp_path / "list.txt").write_text("images/p_0.png\n")
    with pytest.raises(InputError, match="has 10 cameras, but the list next to it names 1 pictures"):
        read(tmp_path)


def test_sdfstudios_frame_is_taken_back_and_priors_are_named(tmp_path, caplog):
    write_sdfstudio(tmp_path, KNOWN)
    content = json.loads((tmp_path / "meta_data.json").read_text())
    content["worldtogt"] = [[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]
    dump(tmp_path / "meta_data.json", content)
    assert AutoReader(root=str(tmp_path)).capture().undo.tolist() == content["worldtogt"]
    said_once(caplog, "mono_depth_path of the frames are not read")


def test_files_of_one_program_in_one_folder_are_named_and_can_be_chosen(tmp_path, caplog):
    write_meshroom(tmp_path, KNOWN)
    dump(tmp_path / "cameras.json", as_text(meshroom(MIDDLE, NOW | {"principalPoint": [0, 0], "pixelRatio": 1})))
    dump(tmp_path / "sfm.sfm", as_text(meshroom(KNOWN, NOW)))
    assert_known(AutoReader(root=str(tmp_path)).capture(), KNOWN)
    said_once(caplog, r"cameras\.sfm is read, and not sfm\.sfm")
    assert_known(AutoReader(root=str(tmp_path / "cameras.json")).capture(), MIDDLE)


@pytest.mark.parametrize(
    ("write", "file", "change", "message"),
    [
        (write_sdfstudio, "meta_data.json", lambda c: c | {"worldtogt": np.diag([1, 1, -1, 1]).tolist()}, "not a rota"),
        (write_splat_cameras, "cameras.json", lambda c: [*c[:2], {}], "img_name is None"),
        (write_openmvg, "sfm_data.json", lambda c: c | {"extrinsics": []}, "openMVG has no poses"),
        (write_meshroom, "cameras.sfm", lambda c: c | {"poses": ""}, r"Meshroom \(AliceVision\) has no poses"),
        (write_meshroom, "cameras.sfm", lambda c: c | {"intrinsics": ""}, "not among the intrinsics"),
    ],
)
def test_json_without_what_is_needed(tmp_path, write, file, change, message):
    write(tmp_path, KNOWN)
    dump(tmp_path / file, change(json.loads((tmp_path / file).read_text())))
    with pytest.raises(InputError, match=message):
        read(tmp_path)


def test_a_matrix_without_inverse_is_no_pose(tmp_path):
    write_mvsnet(tmp_path, KNOWN)
    path = tmp_path / "cams" / "00000003_cam.txt"
    lines = path.read_text().splitlines()
    text(path, [*lines[:1], "0 0 0 0", *lines[2:]])
    assert "determinant 0" in AutoReader(root=str(tmp_path)).capture().left_out.faults["images/00000003"]


def test_points_that_are_broken_are_left_out(tmp_path, caplog):
    write_opensfm(tmp_path, KNOWN)
    whole = opensfm(KNOWN)
    whole["points"]["8"] = {"coordinates": ["x", 1, 2]}
    dump(tmp_path / "reconstruction.json", [whole])
    assert len(AutoReader(root=str(tmp_path)).capture().points) == 0
    said_once(caplog, "its points are left out")


def test_renderings_in_the_output_of_3dgs_are_no_photographs(tmp_path):
    write_splat_cameras(tmp_path, MIDDLE)
    (tmp_path / "point_cloud").mkdir()
    assert_known(AutoReader(root=str(tmp_path)).capture(), MIDDLE)
    (tmp_path / "images").rename(tmp_path / "renders")
    for root in (tmp_path, tmp_path / "cameras.json"):
        with pytest.raises(InputError, match=r"output of .* source_path"):
            read(root)


def test_pictures_may_lie_anywhere_in_the_folder_that_is_named(tmp_path):
    write_meshroom(tmp_path, KNOWN)
    folder = tmp_path / "MeshroomCache" / "StructureFromMotion" / "0a1b"
    folder.mkdir(parents=True)
    (tmp_path / "cameras.sfm").rename(folder / "cameras.sfm")
    (tmp_path / "images").rename(tmp_path / "photos")
    assert_known(AutoReader(root=str(tmp_path)).capture(), KNOWN)
    with pytest.raises(InputError, match=r"no picture below .*0a1b is called /home/user/p_0\.png\. Copy it there\."):
        read(folder)
    assert_known(OtherProgramReader(root=str(tmp_path), images="photos").capture(), KNOWN)
