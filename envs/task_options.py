"""Env options that all tasks share."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from mjx_walk.envs.ground.options import PRESETS as GROUNDS
from mjx_walk.envs.ground.options import Ground
from mjx_walk.envs.model_files import absolute_xml_file, model_path
from mjx_walk.envs.option_presets import changes, preset
from mjx_walk.envs.randomization.options import PRESETS as RANDOMIZATIONS
from mjx_walk.envs.randomization.options import Randomization
from mjx_walk.envs.reward_shaping import Shaping
from mjx_walk.envs.state import NO_TIME_LIMIT
from mjx_walk.envs.user_files import absolute_source
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import Dataclass, setting

__all__ = ["MAX_FRAME_SKIP", "OPTION_PRESETS", "TaskOptions", "check_version", "with_absolute_paths"]

MAX_FRAME_SKIP = 10_000
"""With more, the physics of one environment step takes minutes and cannot be interrupted."""
OPTION_PRESETS: dict[str, Mapping[str, Dataclass]] = {"randomize": RANDOMIZATIONS, "ground": GROUNDS}
"""Presets of groups of env options, by the group."""


@dataclasses.dataclass
class TaskOptions:
    """Env options of all tasks. Subclasses add the keyword arguments of their Gymnasium class."""

    name: str = ""
    version: str = setting("v5", choices=("v5", "v4"))
    """Version of Gymnasium's environment."""
    xml_file: str | None = None
    """Model file: the name of one of Gymnasium's assets, or a path. The file of that name in the working directory is
    `./NAME`. Default: the version's own model."""
    frame_skip: int = setting(5, at_least=1, at_most=MAX_FRAME_SKIP)
    """Physics steps of one environment step."""
    max_episode_steps: int = setting(1000, at_least=1, at_most=NO_TIME_LIMIT)
    """Time limit, in environment steps."""
    shaping: Shaping = dataclasses.field(default_factory=Shaping)
    """Weights of additional reward terms."""
    randomize: Randomization = dataclasses.field(default_factory=Randomization)
    """Randomized physics of training, or the name of a preset."""
    ground: Ground = dataclasses.field(default_factory=Ground)
    """Hills on the floor, or the name of a preset."""
    reward_function: str | None = None
    """`PATH.py:FUNCTION`, a custom reward that replaces Gymnasium's; see `mjx_walk.envs.reward_shaping`."""
    task: str | None = None
    """`PATH.py:CLASS`, for a task of your own from a file; see `mjx_walk.envs.registry`."""

    def __post_init__(self):
        self.xml_file = self.xml_file or None
        for name, presets in OPTION_PRESETS.items():
            if isinstance(getattr(self, name), str):
                setattr(self, name, preset(f"env.{name}", getattr(self, name), presets))
        for name, value in list(vars(self).items()):
            if isinstance(value, list):  # a configuration file gives a range as a list
                setattr(self, name, tuple(value))
            elif isinstance(value, os.PathLike):
                setattr(self, name, os.fspath(value))
        for group in dataclasses.fields(self):
            values, kind = getattr(self, group.name), group.default_factory
            if isinstance(values, dict) and isinstance(kind, type) and dataclasses.is_dataclass(kind):
                unknown = values.keys() - {field.name for field in dataclasses.fields(kind)}
                if unknown:
                    raise UserError(f"unknown key 'env.{group.name}.{min(unknown)}'")
                setattr(self, group.name, kind(**values))

    def changed(self) -> dict[str, object]:
        """Options that differ from their defaults."""
        return changes(self)

    def gymnasium_kwargs(self) -> dict[str, object]:
        """Keyword arguments of Gymnasium's class for the equivalent environment, without those at their default."""
        keywords = {name: value for name, value in self.changed().items() if name not in _NOT_IN_GYMNASIUM}
        if self.xml_file:  # Gymnasium finds relative paths elsewhere
            keywords["xml_file"] = os.path.abspath(model_path(self.xml_file))
        return keywords


_NOT_IN_GYMNASIUM = (
    "name",
    "version",
    "max_episode_steps",
    "shaping",
    "randomize",
    "ground",
    "reward_function",
    "task",
)
"""Fields of `TaskOptions` that the constructors of Gymnasium's classes do not take."""


def check_version(
    options: TaskOptions, available: Iterable[str], missing: Mapping[str, str], exclusive: Mapping[str, tuple[str, ...]]
) -> None:
    """Check that Gymnasium has the version, and that its class takes the options that differ from their defaults.

    Args:
        options: env options.
        available: versions of the task.
        missing: why a version is not available, by version.
        exclusive: env options that only one version takes, by version.

    Raises:
        UserError: it does not.
    """
    name, version = options.name, options.version
    if version not in available:
        reason = missing.get(version, f"unknown version '{version}' of {name}")
        raise UserError(f"{reason}; choose one of: {', '.join(available)}")
    for only, other in (("v5", "v4"), ("v4", "v5")):
        refused = [option for option in exclusive[only] if option in options.changed()]
        if version == other and refused:
            raise UserError(f"{name} {version} does not take {', '.join(refused)}; use version={only}")


def with_absolute_paths(options: TaskOptions, folder: Path) -> TaskOptions:
    """Options whose files stay the same ones when a run is loaded from another working directory.

    Args:
        options: env options as a user gives them.
        folder: what a relative path is relative to.
    """
    xml_file, source = options.xml_file, options.reward_function
    xml_file = absolute_xml_file(xml_file, folder) if xml_file else None
    source = absolute_source(source, folder) if source else source
    task = absolute_source(options.task, folder) if options.task else None
    return dataclasses.replace(options, xml_file=xml_file, reward_function=source, task=task)
