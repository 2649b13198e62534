"""The doctor stops a training only for what is wrong."""

import pytest
from support.scenes import ball_scene

from nerf_lightning.doctor import gate
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import advice
from nerf_lightning.messages.errors import InputError


@pytest.fixture
def verdicts(monkeypatch):
    """What the doctor says."""
    said = []
    monkeypatch.setattr(gate, "examine", lambda scene: (None, said))
    return said


def test_what_is_wrong_stops_the_training_with_the_cure_and_what_else_is_wrong(verdicts):
    verdicts += [
        Check("sharpness", "look", "3 of 20 are blurred", "Leave them out."),
        Check("convention", "wrong", "every camera looks away", "Turn the poses."),
        Check("focal length", "wrong", "twice too long", "Halve it."),
    ]
    with pytest.raises(
        InputError, match=r"convention: every camera looks away\. Turn the poses\. Wrong, too: focal"
    ) as stop:
        gate.require_sound(ball_scene())
    assert "doctor=off trains all the same" in str(stop.value)


def test_what_is_doubtful_is_said_and_training_goes_on(verdicts, caplog):
    caplog.set_level("INFO")
    verdicts += [Check("sharpness", "look", "3 of 20 are blurred", "Leave them out."), Check("lens", "ok", "none")]
    gate.require_sound(ball_scene())
    assert "doctor: sharpness: 3 of 20 are blurred. Leave them out." in caplog.text
    assert "2 checks find nothing wrong" in caplog.text


def test_the_one_advice_is_about_what_no_setting_makes_up_for():
    sharp = Check("sharpness", "look", "3 of 20 are blurred", "Leave them out.")
    gap = Check("coverage", "look", "a gap of 90 degrees", "Take some around 142 degrees.")
    assert advice([Check("lens", "ok", "none"), sharp, gap]) == "Take some around 142 degrees."
    assert advice([sharp]) == "Leave them out."
    assert advice([Check("lens", "ok", "none")]) is None
