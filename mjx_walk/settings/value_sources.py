"""Where each value of a configuration comes from: a default, a recipe or the command line."""

from collections.abc import Iterator
from pathlib import Path

import yaml
from hydra import compose
from hydra.core.config_loader import ConfigLoader
from hydra.core.default_element import ResultDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import OmegaConf

from mjx_walk.settings.config import compose_config, composing
from mjx_walk.settings.overrides import read_overrides
from mjx_walk.settings.recipe_files import with_paths
from mjx_walk.settings.recipes import CONFIG_DIR
from mjx_walk.settings.schema import leaves

__all__ = ["as_yaml_with_sources"]

_RECIPES = Path(CONFIG_DIR) / "recipe"
_COMMAND_LINE = "command line"


def as_yaml_with_sources(overrides: list[str]) -> str:
    """The configuration of a command line as YAML, with a comment after each value that names its source.

    Args:
        overrides: arguments of the command line.

    Raises:
        UserError: as for `load_config`.
    """
    read = read_overrides(overrides)
    compose_config(read)  # checks it
    with composing(read) as texts:
        node = compose("train", texts)
        text = OmegaConf.to_yaml(node, resolve=True)
        sources = _sources(GlobalHydra.instance().config_loader(), texts)
    for key, value in leaves(OmegaConf.to_container(node)):
        if isinstance(value, str) and value.startswith("${"):  # the value of another setting
            sources[key] = f"{sources[key]}: {value}"
    if not any(override.startswith("hardware=") for override in overrides):
        sources["hardware"] = "devices of this machine"
    root = yaml.compose(text)
    assert isinstance(root, yaml.MappingNode)
    for end, key in sorted(_ends(root, ""), reverse=True):
        text = f"{text[:end]}  # {sources.get(key, 'default')}{text[end:]}"
    return text


def _sources(loader: ConfigLoader, overrides: list[str]) -> dict[str, str]:
    """The source of each value by its full key, from the files in the order in which Hydra merges them."""
    found = loader.compute_defaults_list("train", overrides, RunMode.RUN)
    sources: dict[str, str] = {}
    for file in found.defaults:
        sources |= dict.fromkeys(_keys(file, loader), _name(file.config_path or ""))
    sources |= {"env.name": "default", "algo.name": "default"}
    for group, choice in found.overrides.override_metadata.items():
        key = group if group == "hardware" else f"{group}.name"
        sources[key] = _COMMAND_LINE if choice.external_override else _name(choice.containing_config_path or "")
    for override in found.config_overrides:
        sources |= dict.fromkeys((key for key, _ in leaves({override.key_or_group: override.value()})), _COMMAND_LINE)
    return sources


def _keys(file: ResultDefault, loader: ConfigLoader) -> Iterator[str]:
    """The full keys of the values that a file, or a dataclass among Hydra's groups, sets."""
    path, prefix = str(file.config_path), f"{file.package}." if file.package else ""
    for source in loader.get_sources():
        if source.is_config(path):
            yield from (key for key, _ in leaves(OmegaConf.to_container(source.load_config(path).config), prefix))


def _name(path: str) -> str:
    """A file of Hydra's, as a user names it."""
    group, _, name = path.partition("/")
    if group == "recipe":
        recipe = with_paths(name)
        is_shipped = recipe.startswith(CONFIG_DIR)
        return f"recipe {str(Path(recipe).relative_to(_RECIPES).with_suffix('')) if is_shipped else recipe}"
    names = {"env": f"default of {name}", "algo": f"default of {name}", "hardware": f"hardware {name}"}
    return names.get(group, "default")


def _ends(node: yaml.MappingNode, prefix: str) -> Iterator[tuple[int, str]]:
    """For each value of a YAML text, the index at which its line may have a comment, and its full key."""
    for name, value in node.value:
        key = prefix + name.value
        if isinstance(value, yaml.MappingNode) and value.value:
            yield from _ends(value, f"{key}.")
        else:
            is_block = isinstance(value, yaml.SequenceNode) and not value.flow_style
            yield (name.end_mark.index + len(":") if is_block else value.end_mark.index), key
