"""Changes of a MuJoCo model after an engine has read it. They have no effect, so they are refused."""

import fnmatch
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np

from mjx_walk.utils.errors import UserError

__all__ = ["APPEARANCE", "ModelSnapshot"]

APPEARANCE: dict[str, str] = {
    "*_rgba": "colors",
    "*_matid": "materials of geoms, sites, tendons, skins and flexes",
    "mat_*": "materials",
    "tex_*": "textures",
    "light_*": "lights",
    "cam_*": "cameras",
    "skin_*": "skins, which follow the bodies and touch nothing",
    "[!a]*_group": "groups, which frames show or hide; opt.disableactuator reads those of actuators",
    "tendon_width": "width of a drawn tendon",
    "mesh_normal*": "shading of meshes",
    "mesh_facenormal": "shading of meshes",
    "*texcoord*": "where a texture lies on a mesh or a flex",
    "flex_flatskin": "shading of flexes",
    "*_user": "notes of the model's author, which MuJoCo does not read",
    "stat.center": "where a camera looks",
    "stat.extent": "clipping planes and distance of a camera",
    "stat.meanmass": "scale of drawn forces",
    "stat.meansize": "scale of drawn marks",
}
"""Patterns of the model's values that no simulation depends on, and what they are. `model.vis` is appearance, too."""

_SEEN_IN = {
    "cam_*": ("cam_*", "sensordata"),
    "light_*": ("light_*",),
    "*_rgba": ("sensordata",),  # rays of rangefinders pass through what is transparent
    "*_matid": ("sensordata",),
    "mat_*": ("sensordata",),
}
"""Patterns of `APPEARANCE` on which arrays of `mjData` depend, and patterns of those arrays."""


class ModelSnapshot:
    """The values of a model that a task may depend on: all but `APPEARANCE`, unless the task reads it.

    It also sees changes through views, such as `model.geom("floor").friction[0] = 2`.
    """

    def __init__(self, model: mujoco.MjModel, derived: Sequence[str] = ()):
        """
        Args:
            model: the model.
            derived: names of the `mjData` arrays that the task reads.
        """
        ignored = [pattern for pattern in APPEARANCE if not _is_seen(pattern, derived)]
        self._values = dict(_readers(model, ignored))
        self._original = {name: read() for name, read in self._values.items()}

    def names(self) -> tuple[str, ...]:
        """Names of the values, such as `body_mass` and `opt.gravity`."""
        return tuple(self._values)

    def refuse_changes(self) -> None:
        """Check that the model has not changed.

        Raises:
            UserError: it has; names the first value.
        """
        for name, read in self._values.items():
            if read() != self._original[name]:
                raise UserError(f"the physics ignores your change to model.{name}; use xml_file=PATH instead")


def _is_seen(pattern: str, derived: Sequence[str]) -> bool:
    """Whether an array of `mjData` that a task reads depends on values of this pattern."""
    return any(fnmatch.fnmatchcase(name, array) for array in _SEEN_IN.get(pattern, ()) for name in derived)


def _readers(model: mujoco.MjModel, ignored: Sequence[str]) -> Iterator[tuple[str, Callable[[], bytes | float]]]:
    """A function for each value, except for patterns to ignore, that gives its present content."""
    for prefix, owner in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
        for name in dir(owner):
            if name.startswith("_") or any(fnmatch.fnmatchcase(prefix + name, pattern) for pattern in ignored):
                continue
            value = getattr(owner, name)
            if isinstance(value, np.ndarray):
                if value.size:
                    yield prefix + name, value.tobytes  # a view of the model's memory
            elif prefix and isinstance(value, int | float):  # numbers of the model itself cannot be changed
                yield prefix + name, lambda owner=owner, name=name: getattr(owner, name)  # type: ignore[misc]
