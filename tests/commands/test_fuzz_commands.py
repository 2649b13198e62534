"""Damaged files through the command line, one of a family: an exit code of 0, or of 2 with one paragraph."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fuzzing import fuzzed, harmless
from support.measured_runs import leave_measured_run
from support.mutations import damaged, mutated
from support.posed_captures import Known, ring, write_transforms
from support.running import said


def run_of(nerf, *arguments):
    result = harmless(nerf, *arguments)
    if result.code:
        said(result)


@pytest.fixture
def capture(tmp_path):
    return write_transforms(tmp_path / "capture", Known(c2w=ring(4)))


@fuzzed(3)
@given(data=st.data())
def test_doctor_of_a_damaged_capture(nerf, capture, tmp_path, data):
    path = capture / "transforms.json"
    sound = path.read_bytes()
    path.write_text(json.dumps(data.draw(mutated(json.loads(sound)))))
    settings = (f"scene.root={capture}", f"scene.cache_dir={tmp_path}/cache", f"paths.output_dir={tmp_path}/out")
    run_of(nerf, "doctor", "scene=transforms", *settings)
    path.write_bytes(sound)


@fuzzed(3)
@given(data=st.data())
def test_table_of_a_damaged_run(nerf, tmp_path, data):
    run = tmp_path / "runs" / "a"
    if not run.exists():
        leave_measured_run(run)
    path = run / data.draw(st.sampled_from(("metrics.json", "run.json", ".hydra/overrides.yaml")))
    sound = path.read_bytes()
    path.write_bytes(data.draw(damaged(sound)))
    run_of(nerf, "table", str(tmp_path / "runs"), f"paths.output_dir={tmp_path}/out")
    path.write_bytes(sound)
