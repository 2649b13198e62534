import base64
import math

from nerf_lightning.report.curves import curve_drawings
from nerf_lightning.report.page import Report, page


def test_known_curves_are_drawn_together_and_unknown_names_are_not():
    steps = [1, 2, 3]
    curves = {
        "train/psnr_fine": (steps, [10.0, 20.0, 25.0]),
        "val/psnr": (steps, [10.0, 19.0, 23.0]),
        "train/loss": (steps, [0.5, 0.0, math.nan]),
        "memory/resident_gigabytes": ([], []),
        "train/loss_$\\evil": (steps, [1.0, 1.0, 1.0]),
        "<script>": (steps, [1.0, 1.0, 1.0]),
    }
    drawings = {drawing.label: drawing.address for drawing in curve_drawings(curves)}
    assert [drawing.note for drawing in curve_drawings(curves)] == ["", ""]
    assert list(drawings) == ["PSNR (dB)", "loss"]
    kind, _, content = drawings["loss"].partition(",")
    assert kind == "data:image/svg+xml;base64"
    assert base64.b64decode(content).startswith(b"<?xml")
    assert curve_drawings({}) == []


def test_a_few_curves_are_drawn_of_thousands_and_it_is_said():
    curves = {f"train/loss_{number}": ([1, 2], [1.0, 2.0]) for number in range(3000)}
    (drawing,) = curve_drawings(curves)
    assert len(drawing.address) < 200_000
    assert drawing.note == "2988 more curves are in the run's TensorBoard files."
    text = page(Report("a run", curves=[drawing]))
    assert "<figcaption>2988 more curves are in the run&#x27;s TensorBoard files.</figcaption>" in text
