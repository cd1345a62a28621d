"""Hills of boxes on the floor of a model: their heights, and the places where episodes start."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_walk.envs.ground.options import Ground
from mjx_walk.envs.ground.profile import FOOT, ROW_LENGTH, Section, sections
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.utils.errors import UserError

__all__ = ["Hills", "has_hills", "with_hills"]

_WIDTH = 32.0
"""Width of the hills, m."""
_THICKNESS = 0.5
"""Of the boxes below their surface, m."""
_NAME = "hill_"
"""Start of the names of the boxes."""
_FAR = 1e6
"""Farther than a body gets, m."""
_LEAST_GAP = 1e-6
"""Sections that are closer follow each other, m."""
_START_WIDTH = 8.0
"""Width of the places at which bodies with a y coordinate start, m."""
_SHARED = (
    *("contype", "conaffinity", "condim", "friction", "priority", "solref", "solimp", "solmix", "margin", "gap"),
    *("adhesion", "surfacevel", "group"),
)
"""Attributes of the floor that the hills share."""
_PAIR = ("condim", "friction", "solref", "solreffriction", "solimp", "margin", "gap", "adhesion")
"""Attributes of the floor's contact pairs that those of the hills share."""
_COLORS = ([0.45, 0.5, 0.45, 1.0], [0.6, 0.65, 0.6, 1.0])
"""Of neighboring boxes, which show where they end."""


class Hills:
    """Heights of the hills, and the places where episodes start."""

    def __init__(self, ground: Ground):
        """
        Args:
            ground: options of a ground that is not flat.
        """
        self._first_rows = min(ground.first_rows, ground.rows)
        self.sections = sections(ground)
        ends = [-_FAR, *(part.end for part in self.sections)]
        starts = [*(part.start for part in self.sections), _FAR]
        gaps = [pair for pair in zip(ends, starts, strict=True) if pair[1] - pair[0] > _LEAST_GAP]
        parts = sorted([*self.sections, *(Section(start, end, 0.0, 0.0) for start, end in gaps)])
        self._starts = jnp.float32([part.start for part in parts])
        self._first = jnp.float32([part.first for part in parts])
        self._slopes = jnp.float32([(part.last - part.first) / (part.end - part.start) for part in parts])

    def height(self, x: Float[Array, "*shape"], y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Height of the ground above the floor at some places, m."""
        part = jnp.searchsorted(self._starts, x, side="right") - 1
        height = self._first[part] + self._slopes[part] * (x - self._starts[part])
        return jnp.where(jnp.abs(y) <= _WIDTH / 2, height, 0.0)

    def start(self, key: PRNGKeyArray, has_y: bool) -> Float[Array, " place"]:
        """Draw the flat foot of a hill: x, m, and y, m, if the body has that coordinate."""
        row_key, y_key = jax.random.split(key)
        row = jax.random.randint(row_key, (), 0, self._first_rows)
        x = ROW_LENGTH * row + FOOT / 2
        y = jax.random.uniform(y_key, minval=-_START_WIDTH / 2, maxval=_START_WIDTH / 2)
        return jnp.stack([x, y]) if has_y else x[None]


def with_hills(spec: mujoco.MjSpec, hills: Hills, flat: mujoco.MjModel | None = None) -> mujoco.MjModel:
    """The model with hills on its floor. Contacts with them are as with the floor.

    The hills come after all other geoms of the world.

    Args:
        spec: the model, which changes.
        hills: the hills.
        flat: what `spec` was last compiled to, unchanged since. Default: it is compiled here.

    Raises:
        UserError: the model has no floor, several floors, or one that is not level.
    """
    if flat is None:
        with hide_deprecations():
            flat = spec.compile()
    floor, height = _floor(spec, flat)
    name = _NAME
    while any(geom.name.startswith(name) for geom in spec.geoms):
        name = f"_{name}"
    pairs = [pair for pair in spec.pairs if floor.name and floor.name in (pair.geomname1, pair.geomname2)]
    for index, section in enumerate(hills.sections):
        box = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **_box(section, height)._asdict())
        box.name, box.rgba = f"{name}{index}", _COLORS[index % 2]
        for attribute in _SHARED:
            setattr(box, attribute, getattr(floor, attribute))
        for pair in pairs:
            _add_pair(spec, pair, floor.name, box.name)
    # Cameras see as near as on the flat floor.
    spec.stat.extent, spec.stat.center = flat.stat.extent, flat.stat.center
    spec.memory = spec.nstack = spec.njmax = spec.nconmax = -1  # MuJoCo chooses
    with hide_deprecations():
        return spec.compile()


def has_hills(model: mujoco.MjModel, hills: Hills) -> bool:
    """Whether the world of a model has the boxes of the hills, whatever their names and the height of the floor."""
    is_box = (model.geom_bodyid == 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    found = np.hstack([model.geom_size, model.geom_pos[:, :2], model.geom_quat])[is_box]
    boxes = [_box(section, 0.0) for section in hills.sections]
    expected = np.array([[*box.size, *box.pos[:2], *box.quat] for box in boxes])
    return bool(np.isclose(expected[:, None], found).all(axis=2).any(axis=1).all())


class _Box(NamedTuple):
    """Size, m, place, m, and orientation of a geom."""

    size: list[float]
    pos: Float[np.ndarray, "3"]
    quat: list[float]


def _box(section: Section, height: float) -> _Box:
    """The box whose upper face is a section, on a floor of some height, m."""
    length, climb = section.end - section.start, section.last - section.first
    angle = math.atan2(climb, length)
    middle = np.array([(section.start + section.end) / 2, 0.0, height + (section.first + section.last) / 2])
    below = _THICKNESS / 2 * np.array([math.sin(angle), 0.0, -math.cos(angle)])
    return _Box(
        size=[math.hypot(length, climb) / 2, _WIDTH / 2, _THICKNESS / 2],
        pos=middle + below,
        quat=[math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0],
    )


def _floor(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[mujoco.MjsGeom, float]:
    """The plane that bodies can touch and that cannot move, and its height, m."""
    is_plane = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.body_weldid[model.geom_bodyid] == 0)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)} - {""}
    planes = [geom for geom in spec.geoms if is_plane[geom.id]]
    floors = [geom for geom in planes if geom.contype or geom.conaffinity or geom.name in paired]
    if len(floors) != 1:
        raise UserError(f"env.ground needs one plane that bodies can touch as the floor; the model has {len(floors)}")
    floor, data = floors[0], mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if not np.isclose(data.geom_xmat[floor.id, 8], 1.0):
        raise UserError("env.ground needs a level floor; the model's floor is tilted")
    return floor, float(data.geom_xpos[floor.id, 2])


def _add_pair(spec: mujoco.MjSpec, pair: mujoco.MjsPair, floor: str, box: str) -> None:
    """Repeat a contact pair of the floor for a box."""
    names = [box if name == floor else name for name in (pair.geomname1, pair.geomname2)]
    added = spec.add_pair(geomname1=names[0], geomname2=names[1])
    for attribute in _PAIR:
        setattr(added, attribute, getattr(pair, attribute))
