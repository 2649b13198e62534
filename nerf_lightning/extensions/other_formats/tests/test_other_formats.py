"""Captures of other programs give the same rays, as people have them, or are refused in words."""

import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from other_captures import opencv_pose, write_metashape, write_nerfpp, write_neus, write_nsvf, write_polycam
from support.other_formats import SPLIT_AT
from support.plain_capture import (
    ALL,
    KNOWN,
    WITHOUT_3,
    assert_plain,
    everything_is_said,  # noqa: F401
    files,
    plain_rays,  # noqa: F401
    read,
    renamed,
    said_once,
    shown,
    to_utf_16,
)
from support.posed_captures import ring

from nerf_lightning.messages.errors import InputError


def ms(change, chunk=""):
    return partial(write_metashape, change=change, chunk=chunk)


def without_3(new):
    return lambda xml: re.sub(r'label="p_3">.*?</transform>', new, xml)


def gone(pattern):
    return lambda root: [shutil.rmtree(path) if path.is_dir() else path.unlink() for path in root.glob(pattern)]


def made(name):
    return lambda root: (root / name).mkdir()


RAW, OFF = partial(write_polycam, known=KNOWN, shift=5.0), r"photographs have no pose and are left out: p_3"
MATRIX, UNALIGNED = "20 0 8\n0 20 6\n0 0 1", without_3('label="p_3">')
DISABLED = ms(lambda xml: xml.replace('label="p_3"', 'label="p_3" enabled="false"'))
DAMAGED, SECOND = without_3('label="p_3"><transform>1 2</transform>'), partial(re.sub, "<chunk>", "<chunk/><chunk>")
SIZES = rb', "width": 16, "height": 12'


def slave(xml):
    """Take the transform of p_3 away: it is the second camera of a rig, whose first is p_0."""
    first, second = (opencv_pose(KNOWN, view) for view in (0, 3))
    place = np.linalg.inv(first) @ second
    rotation, location = (" ".join(map(str, part)) for part in (place[:3, :3].ravel().tolist(), place[:3, 3].tolist()))
    (sensor,) = re.findall(r"<sensor id.*?</sensor>", xml)
    other = sensor.replace('id="0"', 'id="1" master_id="0"').replace(
        "</sensor>", f"<rotation>{rotation}</rotation><location>{location}</location></sensor>"
    )
    xml = re.sub(r'sensor_id="0" label="p_3">.*?</transform>', 'sensor_id="1" master_id="0" label="p_3">', xml)
    return xml.replace(sensor, sensor + other)


def in_components(xml):
    second = '<component id="1"><transform><scale>9</scale></transform></component>'
    xml = re.sub(r'label="p_([\d])"', lambda match: f'{match[0]} component_id="{int(match[1] == "3")}"', xml)
    return xml.replace("<cameras>", f'<components><component id="0"/>{second}</components><cameras>')


def equal_labels(xml):
    xml = xml.replace('<group id="0">', '<group id="0" label="a">').replace("</group>", '</group><group label="b">')
    return re.sub(r'label="p_4"(.*?</camera>)', r'label="p_0"\1</group>', xml)


def moved_apart(root):
    for group, old in (("a", "p_0.png"), ("b", "p_4.png")):
        (root / "images" / group).mkdir()
        (root / "images" / old).rename(root / "images" / group / "p_0.png")


OTHERS = {
    "polycam": (write_polycam, None, ALL, r"scene=polycam"),
    "polycam corrected": (partial(write_polycam, kind="corrected_"), RAW, ALL, r"has keyframes/corrected_cameras"),
    "polycam, none corrected": (write_polycam, made("keyframes/corrected_cameras"), ALL, r"has keyframes/cameras"),
    "polycam absent": (write_polycam, gone("*/images/103.png"), WITHOUT_3, r"1 of 9 views .* 103\."),
    "polycam without sizes": (
        write_polycam,
        lambda root: files(root, "*/cameras/*.json", lambda said: said.replace(SIZES, b"")),
        ALL,
        r"scene=polycam",
    ),
    "neus": (write_neus, None, ALL, r"scene=neus"),
    "neus negative": (partial(write_neus, factor=-7.0), None, ALL, r"scene=neus"),
    "neus in rgb": (write_neus, renamed("image", "rgb"), ALL, r"scene=neus"),
    "neus large": (write_neus, renamed("cameras_sphere.npz", "cameras_large.npz"), ALL, r"has cameras_large\.npz"),
    "nsvf": (write_nsvf, None, ALL, r"scene=nsvf"),
    "nsvf four numbers": (partial(write_nsvf, line="20 20 8 6"), None, ALL, r"scene=nsvf"),
    "nsvf 3 x 3": (partial(write_nsvf, line=MATRIX, separator=", "), None, ALL, r"scene=nsvf"),
    "nsvf absent": (write_nsvf, gone("rgb/0_0003.png"), WITHOUT_3, r"1 of 9 views .* 0_0003\."),
    "nerfpp": (write_nerfpp, None, ALL, r"scene=nerfpp"),
    "nerfpp val": (partial(write_nerfpp, held="val"), None, ALL, r"scene=nerfpp"),
    "nerfpp absent": (write_nerfpp, gone("test/rgb"), ALL[:6], r"3 of 9 views are left out"),
    "metashape": (write_metashape, None, ALL, r"scene=metashape"),
    "metashape disabled": (DISABLED, None, WITHOUT_3, OFF),
    "metashape unaligned": (ms(UNALIGNED), None, WITHOUT_3, OFF),
    "metashape's rig": (ms(slave), None, ALL, r"scene=metashape"),
    "metashape's rig without a place": (
        ms(lambda xml: re.sub("<location>.*</location>", "", slave(xml))),
        None,
        WITHOUT_3,
        r"1 of 9 .* p_3\. .* has no rotation and location in its rig",
    ),
    "metashape's components": (ms(in_components), None, WITHOUT_3, r"1 photographs of 1 other components, .* p_3\."),
    "metashape's equal labels": (ms(equal_labels), moved_apart, ALL, r"scene=metashape"),
    "metashape damaged": (ms(DAMAGED), None, WITHOUT_3, r"1 of 9 .* p_3\."),
    "metashape's second chunk": (ms(SECOND), None, ALL, r"scene=metashape"),
    "metashape's skew": (
        ms(lambda xml: xml.replace("</f>", "</f><b2>1</b2>")),
        None,
        ALL,
        r"has b2, which is not supported",
    ),
    "metashape in utf-16": (write_metashape, lambda root: files(root, "*.xml", to_utf_16), ALL, r"scene=metashape"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_formats_of_other_programs_give_the_same_rays(tmp_path, plain, caplog, case):
    write, change, views, words = OTHERS[case]
    root = write(tmp_path / "c", known=KNOWN)
    if change:
        change(root)
    scene = read(root)
    assert_plain(scene, plain, views)
    said_once(caplog, words)
    if case.startswith(("nsvf", "nerfpp")) and len(views) > SPLIT_AT:
        assert [shown(scene)[view] for view in scene.splits["test"]] == [6, 7, 8]


def test_neus_photographs_out_of_order_of_their_numbers_are_said(tmp_path, caplog):
    write_neus(tmp_path / "c", replace(KNOWN, c2w=ring(12)), name="{}.png")
    read(tmp_path / "c")
    said_once(caplog, r"in text order \(0\.png, 1\.png, 10\.png.* call them 001, 002")


@pytest.mark.parametrize(
    ("change", "chunk", "message"),
    [
        (lambda xml: xml[:-20], "", r"cameras\.xml cannot be read \(ParseError"),
        (lambda xml: xml.replace("<f>20.0", "<f>20,0"), "", r"holds '20,0' where numbers of a camera belong"),
        (lambda xml: xml.replace("<document", "<!DOCTYPE a><document"), "", r"declares XML entities"),
        (str, "<transform><rotation>1 0 0 0 1 0 0 0 -1</rotation></transform>", r"is not a rotation, a shift"),
        (str, "<transform><rotation>1 0 0</rotation></transform>", r"is not a rotation, a shift"),
    ],
)
def test_metashapes_faults_are_named_with_the_file(tmp_path, change, chunk, message):
    with pytest.raises(InputError, match=message):
        read(write_metashape(tmp_path / "c", KNOWN, change, chunk))
