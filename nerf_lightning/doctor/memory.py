"""What training will take."""

from nerf_lightning.compute.machine import free_memory
from nerf_lightning.data.captures.extent import IN_A_BOX, PHOTOGRAPHS, model_for
from nerf_lightning.doctor.check import Check, Evidence, look, ok

# Bytes that training takes beside the pixels, the program itself included: the most of a process on a CPU, measured.
BESIDE_PIXELS = {IN_A_BOX: 1.1e9, PHOTOGRAPHS: 1.0e9}
MANY_PIXELS = 200e6
SMALL = 64


def memory(evidence: Evidence) -> Check:
    """Judge the memory that training takes, and the size of the photographs."""
    pixels = evidence.scene.pixels
    count = len(pixels.rgba)
    store = pixels.rgba.nbytes + (0 if pixels.mask is None else pixels.mask.nbytes)
    model, reason = model_for(evidence.scene)
    needed, free = store + BESIDE_PIXELS[model], free_memory()
    message = (
        f"{count / 1e6:.1f} million pixels take {store / 1e9:.2f} GB; training with model={model} takes "
        f"about {needed / 1e9:.1f} GB on a CPU, {free / 1e9:.1f} GB are free; model=auto chooses it, since {reason}"
    )
    sides = f"{int(pixels.width.max())} x {int(pixels.height.max())}"
    if needed > free:
        return look(message, "Set scene.downscale=2 (or 4): a quarter (a sixteenth) of the pixels.")
    if count > MANY_PIXELS:
        cure = "On a CPU begin with scene.downscale=2 or 4."
        return look(f"{message}; photographs of {sides} need many steps", cure)
    if int(pixels.width.min()) < SMALL or int(pixels.height.min()) < SMALL:
        return look(f"{message}; photographs of {sides} show little", "Use larger photographs.")
    return ok(message)


CHECKS = {
    "memory": memory,
}
