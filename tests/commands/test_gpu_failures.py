"""A GPU that fails in the midst of a training, by a stand-in: one paragraph, and nothing that was saved is lost."""

import pytest
import torch
from support.running import saved

from nerf_lightning.training.step import TrainStep

FAILURES = {
    torch.AcceleratorError: "CUDA error: unspecified launch failure\nCUDA kernel errors might be reported later",
    RuntimeError: "Triton Error [CUDA]: an illegal memory access was encountered",
}


@pytest.mark.parametrize(
    ("kind", "failing_step", "saved_step"), [(RuntimeError, 3, None), (torch.AcceleratorError, 8, 5)]
)
def test_a_gpu_that_fails_in_a_step_ends_with_the_way_to_go_on(
    train, tmp_path, monkeypatch, kind, failing_step, saved_step
):
    take = TrainStep.__call__

    def fail_once(train_step, *given, **options):
        if train_step.progress.step == failing_step:
            raise kind(FAILURES[kind])
        return take(train_step, *given, **options)

    monkeypatch.setattr(TrainStep, "__call__", fail_once)
    result = train("trainer.max_steps=10", "final.evaluate=false", "final.video=false")
    told = " ".join(result.err.split())
    assert result.code == 2
    assert f"The GPU has failed after step {failing_step}: {FAILURES[kind].splitlines()[0]}" in told
    assert "Traceback" not in result.err + result.out
    if saved_step is None:
        assert "Nothing was saved yet: start again." in told
        return
    assert f"Resume from the last checkpoint with: nerf train resume={tmp_path}/run" in told
    assert saved(tmp_path / "run")["global_step"] == saved_step
    # The stand-in has gone with the command.
    assert train("trainer.max_steps=10", "final.evaluate=false", "final.video=false", "resume=auto").code == 0
    assert saved(tmp_path / "run")["global_step"] == 10
