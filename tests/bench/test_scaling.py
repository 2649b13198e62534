"""`nerf bench scaling=true`: what is fitted, what is measured where, and the capture that it is measured on."""

import json
import math

import pytest
import torch
from omegaconf import OmegaConf
from support.configs import composed

from nerf_lightning.bench import scaling, scaling_point
from nerf_lightning.bench.noise_capture import write_noise_capture
from nerf_lightning.bench.scaling import AXES, Case, benchmark_scaling, exponent
from nerf_lightning.bench.scaling_point import Point, _numbers, measure_point
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.messages.errors import InputError

TINY = (
    "model=nerf_tiny",
    "data.batch_rays=512",
    "trainer.tile_points=4096",
    "data.val_rays=64",
    "scene.resolution=8",
    "scene.num_train=3",
    "scene.num_val=1",
    "scene.num_test=1",
)


@pytest.fixture
def config(tmp_path):
    return composed("bench", "scaling=true", *TINY, f"paths.output_dir={tmp_path}")


@pytest.mark.parametrize("power", [-1.0, 0.0, 0.5, 2.0])
def test_the_exponent_is_that_of_a_power(power):
    assert exponent([(n, 3e-3 * n**power) for n in (1, 4, 10, 100)]) == pytest.approx(power, abs=1e-9)


def test_one_size_has_no_exponent():
    assert math.isnan(exponent([(4.0, 1.0)]))
    assert math.isnan(exponent([(4.0, 1.0), (4.0, 2.0)]))


def test_every_axis_changes_one_setting_of_the_config(config):
    for name, cases in AXES.items():
        sizes = [case.size for case in cases(config)]
        assert sizes == sorted(set(sizes)), name
        for case in cases(config):
            assert all(OmegaConf.select(config, key, default=case) is not case for key in case.settings), name
    fast = composed("bench", "model=fast")
    assert [case.settings["encoder.log2_table_size"] for case in AXES["table"](fast)] == [12, 14, 16, 18, 20]
    assert AXES["table"](config) == []  # it has no table


def test_a_power_is_found_again_and_drawn(config, tmp_path, monkeypatch, capsys):
    def point(_, case, folder):
        return Point(1e-3 * case.size**1.5, 2e-3 * case.size, 1e-4, 0.1 * case.size**0.5, 2.0, 1.0, 3.0)

    monkeypatch.setattr(scaling, "_measured", point)
    found = benchmark_scaling(OmegaConf.merge(config, {"scaling": ["rays", "samples"]}))
    assert found == {"rays": pytest.approx(1.5), "samples": pytest.approx(1.5)}
    shown = capsys.readouterr().out
    assert "grows with power" in shown
    assert "1.50" in shown
    content = json.loads((tmp_path / "scaling.json").read_text())
    assert [row["size"] for row in content["samples"]] == [0.25, 0.5, 1.0, 2.0]
    assert (tmp_path / "scaling.png").stat().st_size > 5000


@pytest.mark.parametrize("wanted", [["rays", "colours"], [], "rays", 3])
def test_axes_that_there_are_none_of_are_refused(config, wanted):
    with pytest.raises(InputError, match="names no axis"):
        benchmark_scaling(OmegaConf.merge(config, {"scaling": wanted}))


def test_an_axis_that_the_model_does_not_have_is_left_out_or_refused(config, monkeypatch):
    monkeypatch.setattr(scaling, "_measured", lambda *_: Point(*[1.0] * 7))
    monkeypatch.setattr(scaling, "_draw", lambda *_: None)
    found = benchmark_scaling(config)
    assert "table" not in found
    assert found["rays"] == 0.0
    with pytest.raises(InputError, match="nothing to change along table"):
        benchmark_scaling(OmegaConf.merge(config, {"scaling": ["rays", "table"]}))


def test_a_point_is_measured(config, monkeypatch):
    monkeypatch.setattr(scaling_point, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(scaling_point, "WINDOWS", 2)
    point = Point(*_numbers(config))
    assert 0 < point.batch_seconds < point.step_seconds < 30
    assert 0 <= point.gigabytes < 8
    assert min(point.processor_seconds, point.reading_seconds, point.again_seconds, point.setup_seconds) > 0


@pytest.mark.exhaustive
def test_what_cannot_be_built_is_told_by_the_process_that_measures(config, tmp_path):
    config.scene = {"_target_": "nerf_lightning.data.readers.transforms.TransformsReader", "root": str(tmp_path)}
    with pytest.raises(InputError, match=r"transforms\.json"):
        measure_point(config)


def test_photographs_of_noise_are_a_capture(tmp_path):
    write_noise_capture(tmp_path / "capture", 12, 32)
    scene = TransformsReader(root=str(tmp_path / "capture"), space="bounded").read()
    assert len(scene.view_names) == 12
    assert scene.pixels.width.tolist() == [32] * 12
    eyes, back = scene.cameras.c2w[:, :, 3], scene.cameras.c2w[:, :, 2]
    # All look at one point, from equally far.
    distance = torch.linalg.lstsq(back - back.mean(dim=0), eyes - eyes.mean(dim=0)).solution.diagonal()[:2].mean()
    looked_at = eyes - distance * back
    torch.testing.assert_close(looked_at, looked_at.mean(dim=0).expand_as(looked_at), atol=1e-3, rtol=0)


def test_a_generated_capture_replaces_the_scene(config, tmp_path, monkeypatch):
    asked = []

    def measure(chosen, processes):
        asked.append((chosen, processes))
        return Point(*[1.0] * 7)

    monkeypatch.setattr(scaling, "measure_point", measure)
    scaling._measured(config, Case(5, {}, photographs=(5, 16)), tmp_path)
    scaling._measured(config, Case(2, {"trainer.num_threads": 1}, processes=2), tmp_path)
    assert asked[0][0].scene.root == str(tmp_path / "5x16")
    assert asked[0][0].scene.cache_dir.startswith(str(tmp_path))  # nothing is left in the user's folder
    assert asked[1][0].trainer.num_threads == 1
    assert asked[1][1] == 2
    assert asked[1][0].scene._target_ == config.scene._target_
