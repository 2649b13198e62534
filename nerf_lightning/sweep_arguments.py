"""The folders of a sweep: one per job, named by what differs."""

from nerf_lightning.conf_folder import conf_folder


def sweep_arguments(arguments: list[str]) -> list[str]:
    """Return the arguments of a sweep with its folders named; those of a single run come back as they are.

    `paths.output_dir` names the folder of the whole sweep, and each job's folder says the values that are swept.

    >>> sweep_arguments(["-m", "seed=0,1", "paths.output_dir=out"])
    ['-m', 'seed=0,1', 'hydra.sweep.dir=out', "hydra.sweep.subdir='${hydra.job.num}_seed=${seed}'"]
    """
    if not {"-m", "--multirun"} & set(arguments):
        return arguments
    renamed = [argument.replace("paths.output_dir=", "hydra.sweep.dir=", 1) for argument in arguments]
    if any(argument.startswith("hydra.sweep.subdir=") for argument in arguments):
        return renamed
    pairs = [argument.partition("=") for argument in arguments]
    swept = [
        key for key, _, values in pairs if ("," in values or "(" in values) and not set("/[{@~+") & set(key + values)
    ]
    parts = ["${hydra.job.num}", *(f"{key}={_current_value(key)}" for key in swept)]
    return [*renamed, f"hydra.sweep.subdir='{'_'.join(parts)}'"]


def _current_value(key: str) -> str:
    is_group = (conf_folder() / key).is_dir()
    return f"${{hydra.runtime.choices.{key}}}" if is_group else f"${{{key}}}"
