"""A config as a tree, for `print_config=true`."""

from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.text import Text
from rich.tree import Tree

from nerf_lightning.messages.escaping import for_terminal


def print_tree(config: DictConfig, console: Console) -> None:
    """Print a config, resolved, one setting a line; what a section is built of stands beside its name."""
    tree = Tree("config")
    _grow(tree, OmegaConf.to_container(config, resolve=True))
    console.print(tree, soft_wrap=True)


def _grow(tree: Tree, node: Any) -> None:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            built = str(value.get("_target_", "")).rpartition(".")[2]
            branch = tree.add(Text(for_terminal(f"{key}  ({built})" if built else str(key)), style="bold"))
            _grow(branch, {name: each for name, each in value.items() if not str(name).startswith("_")})
        else:
            tree.add(Text(for_terminal(f"{key}: {OmegaConf.to_yaml([value]).strip()[2:]}")))
