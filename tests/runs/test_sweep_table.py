"""Rows of a sweep's table, from records and run folders that a test wrote."""

import csv
import json

import yaml

from nerf_lightning.runs.summary import read_run
from nerf_lightning.runs.sweep import job_rows
from nerf_lightning.runs.sweep_job import JobRecord, read_records
from nerf_lightning.runs.table_files import write_csv, write_markdown
from nerf_lightning.runs.table_screen import print_rows


def leave_run(folder, overrides, measured, ssim=0.5, **note):
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (folder / "run.json").write_text(json.dumps({"finished_at_step": 10, "seconds": 3.25} | note))
    if measured is not None:
        (folder / "metrics.json").write_text(json.dumps({"psnr": measured, "ssim": ssim}))


def record(folder, number, overrides, state="finished", **more):
    return JobRecord(number, overrides, str(folder / f"job_{number}"), 1, state, **more)


def test_a_run_folder_is_read_whoever_wrote_it_and_what_is_missing_or_damaged_is_not_known(tmp_path):
    leave_run(tmp_path / "run", ["model=nerf", "seed=3"], 20.5)
    run = read_run(tmp_path / "run")
    assert (run.psnr, run.ssim, run.steps, run.seconds) == (20.5, 0.5, 10, 3.25)
    assert run.overrides == {"model": "nerf", "seed": "3"}
    leave_run(tmp_path / "other", [], None, psnr=17.0)
    assert read_run(tmp_path / "other").psnr == 17.0
    nothing = read_run(tmp_path / "nowhere")
    assert (nothing.psnr, nothing.ssim, nothing.steps, nothing.seconds, nothing.overrides) == (None,) * 4 + ({},)
    for name in ("run.json", "metrics.json", ".hydra/overrides.yaml"):
        (tmp_path / "run" / name).write_text("[1, {")
    assert read_run(tmp_path / "run").overrides == {}
    assert read_run(tmp_path / "run").psnr is None


def test_the_best_comes_first_and_failures_last_and_equal_settings_are_left_out(tmp_path):
    records = []
    for number, (psnr, width, state) in enumerate(
        [(20.0, 32, "finished"), (None, 48, "failed"), (25.0, 64, "finished before"), (30.0, 80, "running")]
    ):
        overrides = ["scene=npz", f"width={width}"]
        leave_run(tmp_path / f"job_{number}", overrides, psnr)
        records.append(record(tmp_path, number, overrides, state))
    rows = job_rows(records, tmp_path)
    assert [row["job"] for row in rows] == [2, 0, 1, 3]
    assert list(rows[0]) == ["job", "width", "PSNR", "SSIM", "steps", "seconds", "state", "folder"]
    assert [row["PSNR"] for row in rows] == [25.0, 20.0, None, None], "the metrics of a run before do not count"
    assert rows[0]["folder"] == "job_2"


def test_a_setting_that_one_job_alone_was_given_is_shown(tmp_path):
    rows = job_rows([record(tmp_path, 0, []), record(tmp_path, 1, ["a=1"])], tmp_path)
    assert [row["a"] for row in rows] == ["", "1"]


def test_files_are_whole_and_the_text_is_short(tmp_path, capsys):
    rows = [
        {"job": 0, "lr": "0.00012520653814999472", "PSNR": 20.123456789, "SSIM": None, "folder": "a|b"},
        {"job": 1, "lr": "1e-3", "PSNR": None, "SSIM": None, "folder": "c"},
    ]
    write_csv(rows, tmp_path / "sweep.csv")
    write_markdown(rows, tmp_path / "sweep.md")
    header, first, *_ = csv.reader((tmp_path / "sweep.csv").read_text().splitlines())
    assert dict(zip(header, first, strict=True))["PSNR"] == "20.123456789"
    assert (tmp_path / "sweep.md").read_text().splitlines() == [
        "| job | lr | PSNR | SSIM | folder |",
        "| --- | --- | --- | --- | --- |",
        "| 0 | 0.000125207 | 20.12 |  | a\\|b |",
        "| 1 | 1e-3 |  |  | c |",
    ]
    print_rows(rows, "sweep of this test", "")
    assert "0.000125207" in capsys.readouterr().out


def test_records_come_back_in_the_order_of_jobs_and_one_that_is_being_written_is_none_yet(tmp_path):
    for number in (10, 9):
        record(tmp_path, number, ["seed=0"], "failed", reason="no rays").write(tmp_path)
    assert [found.number for found in read_records(tmp_path)] == [9, 10]
    assert read_records(tmp_path)[0] == record(tmp_path, 9, ["seed=0"], "failed", reason="no rays")
    (tmp_path / ".hydra" / "jobs" / ".2.77.part.json").write_text('{"num')
    assert [found.number for found in read_records(tmp_path)] == [9, 10]
