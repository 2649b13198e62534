import itertools

import pytest

from nerf_lightning.nerf.optimizers.schedule import Cooldown, ExponentialDecay

SCHEDULES = {
    "exponential": ExponentialDecay(decay_rate=0.03),
    "from the start": Cooldown(cooldown=1.0),
    "half": Cooldown(cooldown=0.5),
    "a tenth": Cooldown(cooldown=0.1),
}


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("num_steps", [1, 7, 500])
def test_a_schedule_begins_with_the_whole_rate_never_rises_and_is_positive_in_the_run(name, num_steps):
    factors = [SCHEDULES[name](step, num_steps) for step in range(num_steps)]
    assert factors[0] == 1.0
    assert min(factors) > 0.0
    assert all(after <= before for before, after in itertools.pairwise(factors))


@pytest.mark.parametrize("cooldown", [0.1, 0.5, 1.0])
def test_the_rate_falls_in_a_straight_line_to_zero_at_the_end_alone(cooldown):
    schedule, begin = Cooldown(cooldown), round(1000 * (1.0 - cooldown))
    assert all(schedule(step, 1000) == pytest.approx(1.0, abs=1e-12) for step in range(begin + 1))
    falls = [schedule(step, 1000) - schedule(step + 1, 1000) for step in range(begin, 1000)]
    assert falls == pytest.approx([1.0 / (1000 * cooldown)] * len(falls), rel=1e-6)
    # What is trained beyond the end, as a budget that was overdrawn, changes nothing.
    assert schedule(1000, 1000) == schedule(1500, 1000) == 0.0


def test_a_longer_run_stretches_the_schedule():
    for schedule in SCHEDULES.values():
        assert schedule(30, 100) == pytest.approx(schedule(300, 1000))


def test_the_rise_while_warming_up_is_the_same_for_all():
    for one in (Cooldown(0.5, warmup_steps=4), ExponentialDecay(decay_rate=1.0, warmup_steps=4)):
        assert [one(step, 100) for step in range(5)] == [0.25, 0.5, 0.75, 1.0, 1.0]


@pytest.mark.parametrize("arguments", [{"cooldown": 0.0}, {"cooldown": 1.5}, {"warmup_steps": -1}])
def test_impossible_cooldowns_are_refused(arguments):
    with pytest.raises(ValueError, match="cooldown must be above 0"):
        Cooldown(**arguments)
