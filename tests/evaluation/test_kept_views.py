import torch

from nerf_lightning.evaluation.kept_views import KeptViews, ScoredView


def view(shade):
    picture = torch.full((12, 12, 3), shade)
    return ScoredView(picture, picture, torch.ones(12, 12), torch.ones(12, 12))


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


def test_none_are_kept_where_none_are_wanted(tmp_path):
    kept = KeptViews(tmp_path, "test", num_worst=0)
    kept.watch("a", 30.0, view(0.5))
    assert kept.finish([{"name": "a", "psnr": 30.0}]) == []
    assert not list(tmp_path.iterdir())
