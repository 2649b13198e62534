import base64
import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.shiny_ball import all_around, record_of

from nerf_lightning.evaluation.main_numbers import main_numbers
from nerf_lightning.extensions.report.charts import CHARTS, MOST_CURVES, drawn
from nerf_lightning.extensions.report.coverage import coverage_map
from nerf_lightning.extensions.report.metrics import WITHOUT_LPIPS, depth_scale, per_image, tables, views_on_page
from nerf_lightning.extensions.report.page import LONGEST_SIDE, Report, embedded, embedded_file, write_report


def decoded(address):
    content = base64.b64decode(address.removeprefix("data:image/webp;base64,"))
    return np.asarray(Image.open(io.BytesIO(content)))


def test_small_pictures_are_kept_exactly_large_ones_shrunk_and_nothing_of_a_file_but_its_pixels(tmp_path):
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    assert (decoded(embedded(picture)) == picture).all()
    wide = embedded(np.zeros((10, 2 * LONGEST_SIDE, 3), dtype=np.uint8))
    assert decoded(wide).shape == (5, LONGEST_SIDE, 3)
    path = tmp_path / "a.png"
    Image.new("RGB", (8, 8), "red").save(path)
    path.write_bytes(path.read_bytes() + b"planted behind the end")
    content = base64.b64decode(embedded_file(path).partition(",")[2])
    assert b"planted" not in content


def test_known_curves_are_drawn_together_and_unknown_names_are_not():
    steps = [1, 2, 3]
    curves = {
        "PSNR/train_fine": (steps, [10.0, 20.0, 25.0]),
        "PSNR/validation": (steps, [10.0, 19.0, 23.0]),
        "Training loss/sum": (steps, [0.5, 0.0, math.nan]),
        "memory/resident_gigabytes": ([], []),
        "Training loss/$\\evil": (steps, [1.0, 1.0, 1.0]),
        "<script>": (steps, [1.0, 1.0, 1.0]),
    }
    (psnr,) = drawn(curves)  # of the losses, one point each can be drawn
    assert (psnr.label, psnr.note) == ("PSNR (dB)", CHARTS[0].note)
    assert [curve["label"] for curve in psnr.curves] == ["training", "validation"]
    assert psnr.curves[0]["values"] == [10.0, 20.0, 25.0]
    two = drawn({f"PSNR/train_{level}": (steps, [1.0, 2.0, end]) for level, end in (("coarse", 3.0), ("fine", 4.0))})
    assert [curve["label"] for curve in two[0].curves] == ["training (coarse)", "training (fine)"]
    assert drawn({}) == []


def test_equal_curves_are_drawn_once_under_both_names_and_sums_over_levels_are_not():
    losses = {"fine": 2.0, "photo_color": 1.0, "photo_interlevel": 3.0, "proposal": 3.0, "sum": 1.0}
    curves = {f"Training loss/{name}": ([1, 2], [9.0, end]) for name, end in losses.items()}
    levels = {f"gradients/norm_{name}": ([1], [1.0]) for name in ("proposal", "fine")}
    (drawing,) = drawn(curves | levels)
    assert [curve["label"] for curve in drawing.curves] == ["color error = sum", "misplaced samples (interlevel)"]


@pytest.mark.parametrize("space", ["contracted", "ndc"])
def test_the_coverage_map_has_a_dot_in_it_for_each_view_and_no_letters_in_its_picture(tmp_path, space):
    record = replace(record_of(all_around()), space=space)
    found = coverage_map(record)
    dots = [dot for _, _, dots in found.splits for dot in dots]
    assert len(found.splits[0][2]) == len(record.splits["train"])
    assert all(0 <= x <= found.width and 0 <= y <= found.height for x, y in dots)
    assert bool(found.covered) == (space != "ndc")
    write_report(Report("a run", coverage=found), tmp_path / "report.html")
    drawing = re.search(r'<svg viewBox="0 0 360.+?</svg>', (tmp_path / "report.html").read_text(), re.DOTALL)[0]
    assert "<text" not in drawing
    assert drawing.count("<circle") == len(dots)


def test_a_few_curves_are_drawn_of_thousands_and_it_is_said(tmp_path):
    curves = {f"Training loss/{number}": ([1, 2], [1.0, 2.0 + number]) for number in range(3000)}
    (drawing,) = drawn(curves)
    assert len(drawing.curves) == MOST_CURVES
    assert drawing.note == f"{CHARTS[1].note} 2988 more curves are in the run's TensorBoard files."
    write_report(Report("a run", charts=[drawing]), tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    note = f"{CHARTS[1].note} 2988 more curves are in the run&#x27;s TensorBoard files."
    assert f'<figcaption class="quiet">{note}</figcaption>' in text


@pytest.mark.parametrize("name", [[], {}, "x" * 5000, "a\x00", 10**400], ids=lambda name: str(name)[:9])
def test_views_of_no_name_are_missing(tmp_path, name):
    metrics = {"per_image": [{"name": name}], "worst_views": [name], "pictures": [name]}
    worst, spread, missing = views_on_page(metrics, tmp_path)
    assert (worst, spread) == ([], [])
    assert len(missing) == 1  # it is among the worst, and is shown once


def test_the_page_says_how_many_views_were_measured_and_what_lpips_needs_where_it_was_not():
    protocol = {"protocol": {"split": "test"}}
    assert ("LPIPS", WITHOUT_LPIPS) in dict(tables(protocol | {"lpips": None}))["Protocol"]
    assert ("LPIPS", WITHOUT_LPIPS) not in dict(tables(protocol | {"lpips": 0.1}))["Protocol"]
    assert dict(tables({}))["Protocol"] == []
    counts = {"num_images": 10, "split_views": 25}
    assert ("test views", "10 of 25") in main_numbers(counts | protocol, {})
    assert ("views measured", "10 of 25") in main_numbers(counts, {})
    assert ("views measured", "25") in main_numbers(counts | {"num_images": 25}, {})
    assert "views measured" not in dict(main_numbers({}, {}))


def test_numbers_have_plain_names_thousands_and_the_unit_that_applies():
    origin = {"parameters": 12525764, "megabytes": 50.1, "seed": 0, "tied": False}
    found = tables({"origin": origin, "protocol": {"psnr": "mean of the pictures' own"}})
    assert [text for _, text in dict(found)["Provenance"]] == ["12,525,764", "50.1", "0", "False"]
    plain = dict(tables({"protocol": {"pixels": "float", "cameras": "raw", "hold_every": "8"}}))["Protocol"]
    assert plain[:2] == [("renders rounded to 8 bits", "no"), ("cameras", "as given")]
    assert ("PSNR", "mean over the pictures") in dict(found)["Protocol"]
    columns, rows = per_image({"per_image": [{"name": "a", "psnr": 28.5, "cc_psnr": 29}]})
    assert (columns, rows) == (["name", "PSNR", "PSNR with fitted colors"], [["a", "28.50 dB", "29.00 dB"]])
    scale = {"near": 2.4444, "far": 9.6, "unit": "meters"}
    assert depth_scale({"depth_scale": scale}) == "bright: 2.44 or nearer, black: 9.6 or farther (meters)"
    assert depth_scale({"depth_scale": {"near": "x"}}) == depth_scale({}) == ""
