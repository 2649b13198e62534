from nerf_lightning.training.callbacks.progress_bar import TrainingProgress


def test_a_training_of_days_says_once_what_takes_minutes(caplog):
    progress = TrainingProgress()
    progress._warn_of_days(3600.0)
    assert caplog.text == ""
    for left in (3_265_128.0, 3_265_000.0):
        progress._warn_of_days(left)
    assert caplog.text.count("the training takes another 38 days") == 1
    assert "budget.seconds=300 ends it in five" in caplog.text
