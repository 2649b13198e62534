"""Damaged run folders: tabled, shown, resumed and swept on, or one paragraph."""

import csv
import json
import re

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.configs import composed
from support.fuzzing import fuzzed, harmless
from support.measured_runs import leave_measured_run
from support.mutations import damaged, damaged_text, mutated

from nerf_lightning.commands import report, table
from nerf_lightning.config.identity import fingerprint, run_identity
from nerf_lightning.messages.escaping import FORMULAS
from nerf_lightning.runs.folder import open_run
from nerf_lightning.runs.saved_overrides import former_overrides, former_sweep
from nerf_lightning.runs.sweep_record import SweepRecord

OVERRIDES = ("scene=blender", "model=fast", "optimizer.lr=2e-3", "scene.root='my data'")
ROW = {"name": "r_0", "psnr": 30.0, "ssim": 0.9, "lpips": None, "seconds": 0.5}
MORE = {
    "median": {"psnr": 30.0},
    "worst": {"psnr": {"name": "r_0", "value": 29.0}},
    "per_image": [ROW, ROW | {"name": "r_1"}],
    "worst_views": ["r_1", "r_0"],
    "pictures": ["r_0"],
    "environment": {"torch": "2.10", "threads": [1, 2]},
}
CHOICES = {"runtime": {"cwd": "/work", "choices": {"scene": "blender", "model": "fast"}}}


@pytest.fixture(autouse=True)
def _no_sweep(monkeypatch):
    """What these commands ask Hydra for beside the config."""
    monkeypatch.setattr("nerf_lightning.runs.output_folder.job_folder", lambda: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs, of which a case damages one."""
    folder = tmp_path_factory.mktemp("runs")
    for number in range(2):
        run = leave_measured_run(folder / "runs" / f"{number}", 30.0 + number, number, OVERRIDES)
        metrics = run / "metrics.json"
        metrics.write_text(json.dumps(json.loads(metrics.read_text()) | MORE))
        for name, content in (("hydra", CHOICES), ("config", {"scene": {"root": "data"}, "seed": number})):
            (run / ".hydra" / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture(scope="module")
def run(folder):
    return folder / "runs" / "0"


FILES = ("metrics.json", "run.json", ".hydra/overrides.yaml", ".hydra/hydra.yaml", ".hydra/config.yaml")


def as_yaml(content) -> bytes:
    return yaml.dump(content, allow_unicode=True).encode("utf-8", "surrogatepass")


@st.composite
def damage(draw, path):
    """Return what a file holds after its values, or its bytes, were changed."""
    sound = path.read_bytes()
    if draw(st.integers(0, 3)) == 0:
        return draw(damaged(sound))
    if path.suffix == ".json":
        return json.dumps(draw(mutated(json.loads(sound)))).encode()
    return as_yaml(draw(mutated(yaml.safe_load(sound)))) if draw(st.booleans()) else draw(damaged_text(sound.decode()))


@pytest.fixture(scope="module")
def replaced(folder):
    """Call something while a file holds something else."""

    def call(path, content, *what):
        sound = path.read_bytes()
        path.write_bytes(content)
        try:
            return harmless(*what)
        finally:
            path.write_bytes(sound)

    return call


@fuzzed(25)
@given(data=st.data())
def test_table(folder, run, replaced, data):
    path = run / data.draw(st.sampled_from(FILES[:4]))
    settings = (f"runs={folder / 'runs'}", f"paths.output_dir={folder / 'out'}")
    replaced(path, data.draw(damage(path)), table.run, composed("table", *settings, "force=true"))
    text = (folder / "out" / "table.csv").read_text()
    for row in csv.reader(text.splitlines()):
        assert not [
            cell for cell in row if cell.startswith(FORMULAS) and not re.fullmatch(r"-[\d.]+(e[+-]?\d+)?", cell)
        ]
    page = (folder / "out" / "table.md").read_text()
    assert "<script" not in page
    assert all(letter.isprintable() or letter == "\n" for letter in text + page)


@fuzzed(25)
@given(data=st.data())
def test_report(folder, run, replaced, data):
    path = run / data.draw(st.sampled_from(FILES))
    settings = (f"run={run}", f"paths.output_dir={folder / 'page'}", "doctor=false")
    if replaced(path, data.draw(damage(path)), report.run, composed("report", *settings)) is not None:
        assert "<script>alert" not in (folder / "page" / "report.html").read_text()


@fuzzed(25)
@given(data=st.data())
def test_resumed_runs(run, replaced, data):
    path = run / ".hydra" / "overrides.yaml"
    lines = replaced(path, data.draw(damage(path)), former_overrides, run, [])
    require_tame(lines or [])


def require_tame(lines):
    assert not [
        line for line in lines if "_target_" in line or "${" in line or line.lstrip("+~").startswith("hydra.run")
    ]


@fuzzed(25)
@given(data=st.data())
def test_resumed_sweeps(folder, replaced, data):
    SweepRecord(["seed=0,1", "hydra/launcher=parallel", "hydra.launcher.n_jobs=2", *OVERRIDES]).write(folder / "sweep")
    path = folder / "sweep" / ".hydra" / "sweep.yaml"
    require_tame(replaced(path, data.draw(damage(path)), former_sweep, folder / "sweep", []) or [])


@fuzzed(25)
@given(data=st.data())
def test_a_run_that_goes_on(folder, data):
    """The note is of this very config, so that the folder is taken."""
    config = composed("train", f"paths.root_dir={folder / 'root'}", "resume=auto")
    run = folder / "root" / "a"
    note = {"fingerprint": fingerprint(run_identity(config)), "started": "2026", "seconds": 3.0, "psnr": 20.0}
    note |= {"finished_at_step": 10, "training_seconds": 5.0}
    changed = data.draw(mutated(note))
    if isinstance(changed, dict):
        changed["fingerprint"] = note["fingerprint"]
    run.mkdir(parents=True, exist_ok=True)
    (run / "run.json").write_text(json.dumps(changed))
    harmless(go_on, config)


def go_on(config):
    run = open_run(config, 100, None)
    try:
        run.resume_point()
        run.trained(1.0)
        run.finish(100, 30.0)
    finally:
        run.release()
