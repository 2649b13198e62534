"""Before hours are spent on a capture: what is wrong with it stops the training, what is doubtful is said."""

import logging

from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import examine
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.types.scene import Scene

log = logging.getLogger(__name__)


def require_sound(scene: Scene) -> list[Check]:
    """Examine a scene, and return what each check says; takes seconds.

    Raises:
        InputError: a check says that it is wrong; with the cure.
    """
    _, checks = examine(scene)
    for check in checks:
        if check.verdict == "look":
            log.warning("doctor: %s: %s. %s", check.name, check.message, check.cure)
    wrong = [check for check in checks if check.verdict == "wrong"]
    if wrong:
        raise InputError(_stopped(scene.name, wrong))
    log.info("doctor: %d checks find nothing wrong (doctor=off leaves them out)", len(checks))
    return checks


def _stopped(name: str, wrong: list[Check]) -> str:
    first, others = wrong[0], [check.name for check in wrong[1:]]
    also = f" Wrong, too: {', '.join(others)}." if others else ""
    return (
        f"The capture {name} is not fit to be trained on. {first.name}: {first.message}. {first.cure}{also} nerf "
        "doctor shows all that it sees, in a picture; doctor=off trains all the same."
    )
