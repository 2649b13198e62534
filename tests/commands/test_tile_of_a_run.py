"""When a run measures its tile, and when that would take longer than it saves."""

import pytest
from support.running import FAST

from nerf_lightning.commands.train_job import fit


@pytest.mark.parametrize(("steps", "measured"), [(2, []), (3, [8192])])
def test_a_short_run_does_not_measure(steps, measured, nerf, capture, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(fit, "SHORT_RUN", 2)
    monkeypatch.setattr(fit, "measured_tile", lambda *given: asked.append(8192) or 8192)
    result = nerf(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "trainer.tile_points=auto", f"trainer.max_steps={steps}",
        "final.evaluate=false", "final.video=false", f"paths.output_dir={tmp_path}",
    )  # fmt: skip
    assert result.code == 0, result.err
    assert asked == measured
