"""Paths as they are typed, or pasted from what a sweep has said."""

from hydra.core.override_parser.overrides_parser import OverridesParser

from nerf_lightning.cli.arguments import quoted_paths


def test_the_folder_of_a_sweeps_job_is_read_as_it_was_printed(tmp_path):
    folder = tmp_path / "0_optimizer.lr=0.03"
    folder.mkdir()
    words = quoted_paths([f"ckpt={folder}", "seed=1", "--cfg=job", f"paths.output_dir={tmp_path}/a=b"])
    assert words[1:] == ["seed=1", "--cfg=job", f"paths.output_dir={tmp_path}/a=b"]
    assert OverridesParser.create().parse_overrides(words[:1])[0].value() == str(folder)


def test_what_is_quoted_already_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a=b").mkdir()
    assert quoted_paths(["ckpt='a=b'", "ckpt=a\\=b"]) == ["ckpt='a=b'", "ckpt=a\\=b"]
