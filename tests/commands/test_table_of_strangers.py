"""`nerf table` of run folders that anybody may have made: damaged results are left out, and texts stay texts."""

import json

import pytest
from support.measured_runs import leave_measured_run, ours


def test_texts_of_strangers_stay_texts(table, tmp_path):
    names = ("=cmd|' /C calc'!A0", "<script>alert(1)</script>", "[/red]\x1b[2J| a\nb")
    for number, name in enumerate(names):
        leave_measured_run(tmp_path / "runs" / str(number), origin={"model": name, "config": name})
    result, rows = table("published=false")
    assert result.code == 0, result.err
    assert "\x1b[2J" not in result.out
    assert {row["model"][0] for row in rows} == {"'", "<", "["}
    text = (tmp_path / "out" / "table.md").read_text()
    assert "<script>" not in text
    assert len(text.splitlines()) == 2 + len(names)
    page = (tmp_path / "out" / "table.html").read_text()
    assert "<script>alert" not in page
    assert "\x1b" not in page


DAMAGED = {
    "not json": "{",
    "a list": "[]",
    "no numbers": '{"psnr": "30"}',
    "a huge number": f'{{"psnr": 1{"0" * 400}}}',
    "NaN": '{"psnr": NaN}',
    "deep": "[" * 100 + "]" * 100,
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_metrics_are_no_numbers(table, tmp_path, content):
    leave_measured_run(tmp_path / "runs" / "a")
    run = leave_measured_run(tmp_path / "runs" / "b")
    (run / "metrics.json").write_text(content)
    result, rows = table()
    assert result.code == 0, result.err
    assert len(ours(rows)) == 1
    assert "runs/b" in " ".join(result.out.split())


DAMAGED_ORIGINS = [
    {"seed": [1], "parameters": "x", "model": {"a": 1}},
    {"seed": None, "config": ["a", {"b": []}], "scene": [], "version": {}, "megabytes": True},
    *({"seed": seed} for seed in ("--5", "-", "\u0663", "\u00b2", "9" * 5000, 1.5, True)),
    {"seed": None, "model": "\ud800", "scene": "\ud800", "device": "\ud800"},
]


@pytest.mark.parametrize("origin", DAMAGED_ORIGINS, ids=lambda origin: ascii(origin)[:40])
def test_damaged_parts_of_metrics_are_left_out(table, tmp_path, origin):
    run = leave_measured_run(tmp_path / "runs" / "a", started=7, finished_at_step=["x"], training_seconds={})
    content = {"psnr": 20.0, "ssim": [], "protocol": 3, "origin": origin}
    (run / "metrics.json").write_text(json.dumps(content))
    leave_measured_run(tmp_path / "runs" / "b", 19.0, seed=1)
    result, rows = table("force=true")
    assert result.code == 0, result.err
    assert "20.0" in [row["PSNR"] for row in rows]
    assert all(row["seeds"] in ("", "1") for row in ours(rows))
