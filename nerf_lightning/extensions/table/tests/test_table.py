"""`nerf table`: which runs it finds, what it puts together and refuses; of strangers' runs, texts stay texts."""

import csv
import json
import statistics

import pytest
from support.measured_runs import PROTOCOL, leave_measured_run, ours
from support.running import done, said


def test_seeds_become_a_mean_and_a_deviation(table, tmp_path):
    values = (30.0, 31.0, 35.0)
    for seed, value in enumerate(values):
        leave_measured_run(tmp_path / "runs" / f"{seed}_seed={seed}", value, seed)
    leave_measured_run(tmp_path / "runs" / "other", 33.0, origin={"model": "nerf", "config": "other"})
    result, rows = table("published=false")
    assert result.code == 0, result.err
    assert [row["model"] for row in rows] == ["nerf", "fast"]
    assert rows[1]["seeds"] == "0 1 2"
    assert float(rows[1]["PSNR"]) == pytest.approx(32.0)
    assert float(rows[1]["PSNR std"]) == pytest.approx(statistics.stdev(values))
    assert rows[0]["PSNR std"] == ""
    assert (float(rows[1]["minutes"]), float(rows[1]["MB"])) == (1.5, 0.004)
    assert "LPIPS" not in rows[0]


def test_settings_that_differ_make_rows_of_their_own(table, tmp_path):
    for number, (rate, space) in enumerate((("1e-2", "bounded"), ("1e-3", "contracted"))):
        overrides = (f"optimizer.lr={rate}", f"scene.space={space}", "trainer.max_steps=10")
        leave_measured_run(tmp_path / "runs" / str(number), 20.0 + number, overrides=overrides)
    _, rows = table("published=false")
    assert [(row["optimizer.lr"], row["scene.space"]) for row in rows] == [("0.001", "contracted"), ("0.01", "bounded")]
    assert "trainer.max_steps" not in rows[0]


def test_what_a_run_did_not_say_is_told_from_its_config(table, tmp_path):
    for number, overrides in enumerate(((), ("optimizer.lr=1e-3", "refinement=se3"))):
        run = leave_measured_run(tmp_path / "runs" / str(number), 20.0 + number, overrides=overrides)
        (run / ".hydra" / "config.yaml").write_text("optimizer: {lr: 0.03}\nrefinement: {_target_: x}\n")
        (run / ".hydra" / "hydra.yaml").write_text("runtime: {choices: {refinement: none, model: fast, scene: a}}\n")
    _, rows = table("published=false")
    assert [(row["optimizer.lr"], row["refinement"]) for row in rows] == [("0.001", "se3"), ("0.03", "none")]


BESIDE_THE_RESULT = (
    *("model={}", "scene={}", "scene@scene={}", "resume={}", "path={}", "path.num_frames={}", "logger={}"),
    *("logger.tensorboard.name={}", "~logger.tensorboard={}", "paths.output_dir={}", "sweep.resume={}"),
    *("viewer={}", "viewer.live_view.port={}", "budgets.views={}", "scene.verify={}"),
    *("final.video={}", "evaluation.num_worst={}", "scene.root={}/lego", "scene.name={}", "scene.cache_dir={}"),
)


def test_where_things_lie_and_what_is_said_of_a_run_makes_no_row(table, tmp_path):
    for seed in (0, 1):
        overrides = tuple(override.format(seed) for override in BESIDE_THE_RESULT)
        leave_measured_run(tmp_path / "runs" / str(seed), 30.0, seed, overrides)
    _, (row,) = table("published=false")
    assert row["seeds"] == "0 1"
    assert not [column for column in row if "=" in column or "." in column]


@pytest.mark.parametrize("place", ["scene.root=data/{}", "scene.path='data/{}.npz'"])
def test_a_scene_that_bears_its_formats_name_is_called_by_its_folder_with_its_dots(table, tmp_path, place):
    for name in ("lego_200", "room.v3"):
        overrides = ("scene=blender", place.format(name))
        leave_measured_run(tmp_path / "runs" / name, protocol={"scene": "blender"}, overrides=overrides)
    _, rows = table()
    assert [row["scene"] for row in ours(rows)] == ["lego_200", "room.v3"]
    assert len(rows) == 13  # eleven have published theirs of lego


def test_published_numbers_stand_below_with_their_source(table, tmp_path):
    leave_measured_run(tmp_path / "runs" / "a", 33.0)
    leave_measured_run(tmp_path / "runs" / "b", 20.0, protocol={"scene": "bricks"}, origin={"scene": "bricks"})
    result, rows = table()
    assert [row["scene"] for row in ours(rows)] == ["bricks", "lego"]
    published = [row for row in rows if row["source"]]
    assert {row["scene"] for row in published} == {"lego"}
    assert rows.index(published[0]) > rows.index(ours(rows)[1])
    assert ("NeRF", "32.54") in [(row["model"], row["PSNR"]) for row in published]
    assert all("800 x 800" in row["source"] for row in published)
    assert any("arXiv 2003.08934" in row["source"] for row in published)
    assert "Zip-NeRF (published)" in result.out


@pytest.mark.parametrize(
    ("protocol", "words"),
    [
        ({"pixels": "8-bit"}, ("runs/a", "runs/b", "pixels: float and 8-bit", "force=true", "measured=eval")),
        ({"split_hash": "f" * 16, "resolution": [[400, 400]]}, ("(resolution: 800 x 800 and 400 x 400)",)),
        ({"split_hash": "f" * 16}, ("(different views, although the settings are the same: the capture has changed)",)),
    ],
)
def test_another_protocol_is_refused_and_the_difference_named(table, tmp_path, protocol, words):
    leave_measured_run(tmp_path / "runs" / "a")
    leave_measured_run(tmp_path / "runs" / "b", protocol=protocol, origin={"config": "b"})
    said(table()[0], *words)
    assert not (tmp_path / "out").exists()


def test_other_pictures_are_told_by_the_settings_that_chose_them(table, tmp_path):
    asked = {"a": ("scene.num_test=8", "scene.cache_dir=x"), "b": ("scene.num_test=16", "optimizer.lr=1e-2"), "c": ()}
    for name, overrides in asked.items():
        leave_measured_run(
            tmp_path / "runs" / name, overrides=overrides, protocol={"split_hash": name * 16}, origin={"config": name}
        )
    result, _ = table("models=fast")
    said(result, "runs/a", "runs/b", "(different views: scene.num_test=8 and scene.num_test=16)")
    assert "split_hash" not in result.err
    text = table("force=true")[0].out
    assert "Not all of these were measured the same way" in text
    assert "different views: scene.num_test=8 and scene.num_test not set" in text
    assert "split_hash" not in text


def test_a_class_of_ones_own_has_the_column_of_its_group(table, tmp_path):
    losses = {"a": ("loss._target_=my_losses.L1", "+loss.part=0.5"), "b": ("loss=robust",), "c": ()}
    for name, overrides in losses.items():
        leave_measured_run(tmp_path / "runs" / name, overrides=overrides, origin={"config": name})
    _, rows = table("published=false")
    assert sorted(row["loss"] for row in rows) == ["", "my_losses.L1", "robust"]
    assert {row["loss.part"] for row in rows} == {"", "0.5"}
    assert not [column for column in rows[0] if "_target_" in column or "+" in column]


def test_force_names_every_difference_once(table, tmp_path):
    leave_measured_run(tmp_path / "runs" / "a")
    leave_measured_run(tmp_path / "runs" / "b", protocol={"pixels": "8-bit"}, origin={"config": "b"})
    leave_measured_run(tmp_path / "runs" / "c", protocol={"pixels": "8-bit", "background": "black"})
    leave_measured_run(tmp_path / "runs" / "d", protocol={"scene": "chair", "split": "val"})
    result, _ = table("force=true")
    text = (tmp_path / "out" / "table.md").read_text()
    assert result.code == 0, result.err
    notes = [line for line in text.splitlines() if "measured the same way" in line]
    assert [note.split(": ", 2)[2] for note in notes] == [
        "pixels: float and 8-bit.",
        "background: white and black.",
        "split: test and val.",
    ]
    assert [note.count(f"/runs/{run}") for note, run in zip(notes, "bcd", strict=True)] == [1, 1, 1]


def test_whatever_was_measured_differently_is_refused(table, tmp_path):
    leave_measured_run(tmp_path / "runs" / "a")
    chair = {"scene": "chair", "background": "black", "split": "val"}
    leave_measured_run(tmp_path / "runs" / "b", protocol=chair)
    refused = table()[0]
    said(refused, "split: test and val")
    assert "background" not in refused.err
    for name, backbone in (("b", "alex, version 0.1"), ("c", "vgg, version 0.1")):
        leave_measured_run(tmp_path / "lpips" / name, protocol={"lpips": backbone}, origin={"config": name})
    leave_measured_run(tmp_path / "lpips" / "a", origin={"config": "a"})
    (tmp_path / "runs").rename(tmp_path / "others")
    (tmp_path / "lpips").rename(tmp_path / "runs")
    said(table()[0], "runs/b", "runs/c", "lpips: alex, version 0.1 and vgg, version 0.1")
    # What was measured before the stamp was whole, too.
    old = {key: value for key, value in PROTOCOL.items() if key not in ("cameras", "masks", "lpips")}
    (tmp_path / "runs" / "b" / "metrics.json").write_text(json.dumps({"psnr": 20.0, "protocol": old}))
    said(table()[0], "cameras: raw and not said")


def test_another_device_or_version_is_noted_below(table, tmp_path):
    leave_measured_run(tmp_path / "runs" / "a")
    leave_measured_run(tmp_path / "runs" / "b", seed=1, origin={"device": "NVIDIA H200"})
    result, rows = table()
    assert ours(rows)[0]["seeds"] == "0 1"
    assert "device: NVIDIA H200, cpu" in result.out


def test_the_newest_of_equal_runs_counts(table, tmp_path):
    leave_measured_run(tmp_path / "runs" / "new", 31.0, started="2026-02-01T00:00:00")
    leave_measured_run(tmp_path / "runs" / "old", 30.0)
    result, rows = table()
    assert [row["PSNR"] for row in ours(rows)] == ["31.0"]
    assert "runs/old" in " ".join(result.out.split())


def test_rows_are_chosen_and_sorted(table, tmp_path):
    for name, value, seconds in (("fast", 30.0, 60.0), ("fast_small", 28.0, 30.0), ("nerf", 29.0, 600.0)):
        leave_measured_run(
            tmp_path / "runs" / name, value, origin={"model": name, "config": name}, training_seconds=seconds
        )
    assert [row["model"] for row in ours(table("sort=minutes")[1])] == ["fast_small", "fast", "nerf"]
    assert [row["model"] for row in ours(table("models=fast*")[1])] == ["fast", "fast_small"]
    assert [row["model"] for row in ours(table("models=[nerf,fast_*]")[1])] == ["nerf", "fast_small"]
    said(table("models=gnt")[0], "No run matches models=[gnt].", "fast, fast_small, nerf")
    said(table("sort=speed")[0], "sort=speed", "frames_per_second")


def test_what_nerf_eval_measured_can_be_taken_instead(table, tmp_path):
    run = leave_measured_run(tmp_path / "runs" / "a", 30.0)
    (run / "evaluation").mkdir()
    again = json.loads((run / "metrics.json").read_text()) | {"psnr": 25.0}
    (run / "evaluation" / "metrics.json").write_text(json.dumps(again))
    leave_measured_run(tmp_path / "runs" / "b", 29.0, seed=1)
    assert [row["PSNR"] for row in ours(table()[1])] == ["29.5"]
    result, rows = table("measured=eval")
    assert [row["PSNR"] for row in ours(rows)] == ["25.0"]
    assert "runs/b" in " ".join(result.out.split())


def test_nothing_to_show_is_said(nerf, table, tmp_path, monkeypatch):
    said(nerf("table", tmp_path / "nowhere"), "nowhere", "does not exist")
    (tmp_path / "runs").mkdir()
    said(table()[0], "no run in")
    leave_measured_run(tmp_path / "runs" / "a", None)
    said(table()[0], "None of the 1 runs has a PSNR in metrics.json")
    monkeypatch.chdir(tmp_path)
    said(nerf("table"), "runs=outputs: outputs does not exist")


def test_the_steps_of_a_run_that_never_finished_and_what_was_evaluated_alone_come_from_measurements(table, tmp_path):
    sizes = {"resolution": [[8, 6], [8, 9], [9, 9]]}
    leave_measured_run(tmp_path / "runs" / "a", protocol=sizes, origin={"step": 70}, finished_at_step=None)
    (row,) = ours(table()[1])
    assert (row["steps"], row["resolution"]) == ("70", "8 x 6 and 2 more")
    (tmp_path / "runs" / "a" / "run.json").unlink()
    assert len(ours(table()[1])) == 1


def test_the_psnr_of_fitted_colours_has_a_column_where_it_was_measured(table, tmp_path):
    run = leave_measured_run(tmp_path / "runs" / "a")
    assert "cc PSNR" not in table()[1][0]
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {"cc_psnr": 31.5}))
    assert ours(table("sort=cc_psnr")[1])[0]["cc PSNR"] == "31.5"


@pytest.mark.parametrize("width", [80, 160])
def test_a_table_fits_its_terminal_and_cuts_no_header(table, tmp_path, monkeypatch, width):
    for number in range(3):
        overrides = tuple(f"model.levels.fine.a{key}.some_long_setting={number}" for key in range(6))
        for seed in (0, 1):
            leave_measured_run(tmp_path / "runs" / f"{number}_{seed}", 20.0 + seed, seed, overrides)
    monkeypatch.setenv("COLUMNS", str(width))
    result, _rows = table()
    lines = result.out.splitlines()
    end = next(number for number, line in enumerate(lines) if line.startswith("Columns left out: "))
    assert max(map(len, lines[:end])) <= width
    assert result.out.count("20.50 ± 0.71") == 3
    rule = next(number for number, line in enumerate(lines) if line.startswith("─"))
    head = " ".join(lines[2:rule]).split()
    assert {"model", "PSNR", "resolution", "some_long_setting"} <= set(head)
    whole = ["scene", "model", "resolution", "PSNR", "time", "steps", "some_long_setting", "SSIM", "seeds", "MB"]
    assert set(head) <= {*whole, *(f"a{key}." for key in range(6))}
    assert f"a{head.count('some_long_setting')}.some_long_setting" in f"{lines[end]} a6.some_long_setting"


def test_a_real_run_is_a_row(nerf, finished_run, tmp_path):
    done(nerf("table", finished_run, f"out={tmp_path}"))
    (row,) = csv.DictReader((tmp_path / "table.csv").read_text().splitlines())
    metrics = json.loads((finished_run / "metrics.json").read_text())
    assert (row["scene"], row["model"], row["steps"]) == ("ball", "nerf_tiny", "20")
    assert float(row["PSNR"]) == metrics["psnr"]


def test_latex_has_the_best_in_bold_and_the_protocol_in_its_caption(table, nerf, tmp_path):
    for number, (model, psnr) in enumerate((("a_b", 30.0), ("a_b", 31.0), ("c", 29.0))):
        leave_measured_run(tmp_path / "runs" / str(number), psnr, number, origin={"model": model})
    assert nerf("table", tmp_path / "runs", "published=false", f"out={tmp_path}/t.tex").code == 0
    text = (tmp_path / "t.tex").read_text()
    assert r"a\_b & \textbf{30.50 $\pm$ 0.71}" in text
    assert r"\textbf{29.00}" not in text
    assert "test views, white background" in text.partition(r"\begin{tabular}")[0]
    said(nerf("table", tmp_path / "runs", "out=t.pdf"), "out=t.pdf: tables are written as .md, .csv, .html, .tex")


FILES = {"table.csv", "table.html", "table.md", "table.tex"}


def test_files_are_written_only_where_they_are_asked_for(nerf, tmp_path, monkeypatch):
    leave_measured_run(tmp_path / "runs" / "a")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert nerf("table", tmp_path / "runs").code == 0
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["a"]
    assert list((tmp_path / "here").iterdir()) == []
    for out, wanted in (("out=tables", FILES), ("out=tables/own.csv", FILES | {"own.csv"})):
        monkeypatch.chdir(tmp_path / "here")
        assert nerf("table", tmp_path / "runs", out).code == 0
        assert {path.name for path in (tmp_path / "here" / "tables").iterdir()} == wanted


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
