"""Env options that all tasks share."""

import dataclasses
from typing import Any

from mjx_walk.envs.models import model_path
from mjx_walk.envs.reward_shaping import Shaping
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting


@dataclasses.dataclass
class TaskOptions:
    """Env options of all tasks. Subclasses add the keyword arguments of their Gymnasium class."""

    name: str = ""
    version: str = setting("v5", choices=("v5", "v4"))
    xml_file: str | None = None
    """Model file, resolved as in Gymnasium. Default: the version's own model."""
    frame_skip: int = setting(5, at_least=1)
    max_episode_steps: int = setting(1000, at_least=1)
    shaping: Shaping = dataclasses.field(default_factory=Shaping)
    """Weights of additional reward terms."""
    reward_function: str | None = None
    """`PATH.py:FUNCTION`, a custom reward that replaces Gymnasium's; see `mjx_walk.envs.reward_shaping`."""

    def __post_init__(self):
        for name, value in list(vars(self).items()):
            if isinstance(value, list):  # a configuration file gives a range as a list
                setattr(self, name, tuple(value))
        if self.xml_file and model_path(self.xml_file).is_file():
            # An absolute path stays valid when a run is loaded from another working directory.
            self.xml_file = str(model_path(self.xml_file).resolve())
        if isinstance(self.shaping, dict):
            unknown = self.shaping.keys() - {field.name for field in dataclasses.fields(Shaping)}
            if unknown:
                raise UserError(f"unknown key 'env.shaping.{min(unknown)}'")
            self.shaping = Shaping(**self.shaping)

    def changed(self) -> dict[str, Any]:
        """Options that differ from their defaults."""
        defaults = vars(type(self)())
        return {name: value for name, value in vars(self).items() if value != defaults[name]}
