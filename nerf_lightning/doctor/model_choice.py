"""Which model suits a scene."""

from nerf_lightning.nerf.types.scene import Scene

IN_A_BOX, PHOTOGRAPHS = "fast", "fast_proposal"


def model_for(scene: Scene) -> tuple[str, str]:
    """Return the model that suits a scene, as model=auto chooses it, and why."""
    if scene.space == "bounded":
        return IN_A_BOX, "the scene stands in a box"
    return PHOTOGRAPHS, "the photographs show whatever lies behind the content"
