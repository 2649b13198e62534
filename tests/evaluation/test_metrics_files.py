"""What an evaluation leaves: json, whatever was measured, and pictures of the worst views."""

import json
import math

import pytest
import torch

from nerf_lightning.evaluation.kept_views import KeptViews, ScoredView
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.evaluation.metrics_files import METRICS, summary, write_metrics
from nerf_lightning.files.json_files import write_json
from nerf_lightning.runs.summary import read_run


def strict_json(path):
    def refuse(word):
        raise AssertionError(f"{word} is no json")

    return json.loads(path.read_text(), parse_constant=refuse)


def row(name, **values):
    return {"name": name, "seconds": 1.0} | dict.fromkeys(METRICS) | values


def test_a_view_without_any_number_is_null_and_one_that_is_background_alone_keeps_the_runs_numbers(tmp_path):
    rows = [row("a", psnr=20.0, ssim=math.nan), row("b", psnr=math.inf, ssim=0.5)]
    write_metrics(tmp_path, summary(rows))
    content = strict_json(tmp_path / "metrics.json")
    assert [picture["psnr"] for picture in content["per_image"]] == [20.0, None]
    assert content["ssim"] is None
    assert content["worst"]["psnr"] == {"name": "a", "value": 20.0}
    white, render = torch.ones(16, 16, 3), torch.full((16, 16, 3), 0.9)
    rows = [row("empty", **image_metrics(white, white)), row("b", **image_metrics(render, white))]
    write_metrics(tmp_path, summary(rows))
    assert read_run(tmp_path).psnr == pytest.approx(60.0, abs=1e-3)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_null_however_deep_it_lies(tmp_path, number):
    write_json(tmp_path / "a.json", {"a": [1, {"b": number}], "c": (number, 2.5), "d": "NaN", "e": True})
    assert strict_json(tmp_path / "a.json") == {"a": [1, {"b": None}], "c": [None, 2.5], "d": "NaN", "e": True}


def view(shade):
    picture = torch.full((12, 12, 3), shade)
    return ScoredView(picture, picture, torch.ones(12, 12), torch.ones(12, 12), (0.5, 2.0))


def test_the_worst_of_all_processes_are_kept_in_order(tmp_path):
    scores = {"a": 10.0, "b": 30.0, "c": 25.0, "d": 20.0, "e": 35.0}
    rows = [{"name": name, "psnr": psnr} for name, psnr in scores.items()]
    # Two processes share the views in turn.
    processes = [KeptViews(tmp_path, "test", num_worst=2) for _ in range(2)]
    for number, (name, psnr) in enumerate(scores.items()):
        kept = processes[number % 2]
        kept.watch(name, psnr, view(0.1 * number))
        assert len(kept.worst) <= 2
    assert {tuple(kept.finish(rows)) for kept in processes} == {("a", "d")}
    for kept in processes:
        kept.close()
    written = sorted(path.relative_to(tmp_path / "images").as_posix() for path in tmp_path.rglob("*.png"))
    assert [name for name in written if "/" not in name] == ["worst_1.png", "worst_2.png"]
    assert "views/worst_1/truth.png" in written
