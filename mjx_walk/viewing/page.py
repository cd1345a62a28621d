"""A self-contained web page that plays an episode in 3D, in any browser and offline."""

import base64
import importlib.util
import json
import re
import string
from pathlib import Path

import mujoco
import numpy as np

from mjx_walk.envs import View
from mjx_walk.storage.files import write_text
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import format_score
from mjx_walk.viewing.episode import Episode

__all__ = ["require_library", "write_page"]

_TEMPLATE = Path(__file__).with_name("page.html")
_SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Shapes that the page can draw."""
_NUM_VISIBLE_GROUPS = 3
"""MuJoCo's viewer shows the geoms of the first three groups; models use the others for collisions."""


def require_library() -> Path:
    """Path of the JavaScript library that a page embeds: MeshCat's viewer, which contains three.js.

    Raises:
        UserError: MeshCat is not installed.
    """
    # The page needs only this file, so MeshCat is not imported.
    package = importlib.util.find_spec("meshcat")
    if package is None or not package.submodule_search_locations:
        raise UserError("html= needs MeshCat, whose 3D viewer the page embeds: pip install meshcat")
    return Path(package.submodule_search_locations[0]) / "viewer" / "dist" / "main.min.js"


def write_page(episode: Episode, path: Path) -> Path:
    """Write the page, about 1.5 MB.

    Raises:
        UserError: MeshCat is not installed.
    """
    model = episode.model
    length = f"{len(episode.rewards)} steps, {episode.seconds[-1]:.1f} s"
    where = ", in the real Gymnasium" if episode.is_in_gymnasium else ""
    data = {
        "summary": f"return {format_score(episode.rewards.sum())} in {length}{where}",
        "num_steps": len(episode.rewards),
        "num_bodies": model.nbody,
        "seconds_per_step": episode.seconds_per_step,
        "body": episode.view.body,
        "body_name": episode.body_name,
        **_camera(episode),
        "geoms": _geoms(model),
        "floors": _rounded(model.geom_pos[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, 2]),
        "poses": base64.b64encode(_body_poses(episode).astype("<f4").tobytes()).decode(),
        "returns": _rounded(np.cumsum(episode.rewards), 2),
        "series": {name: _rounded(values, 4) for name, values in episode.reward_terms.items()},
    }
    page = string.Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=episode.env,
        library=_inside_script(require_library().read_text(encoding="utf-8")),
        episode=json.dumps(data, separators=(",", ":")).replace("<", r"\u003c"),  # no string can end the element
    )
    write_text(path, page)
    return path


def _camera(episode: Episode) -> dict[str, object]:
    """The point that stays in the middle of the page, and the camera's place relative to it.

    The point moves with the body if the view follows it; then it is at 0.6 of the body's greatest height. Places are in
    three.js's coordinates: x to the right, y up, z towards the viewer.
    """
    view = episode.view
    azimuth, elevation = np.deg2rad((view.azimuth, view.elevation))
    sight = np.array((np.cos(elevation) * np.cos(azimuth), np.sin(elevation), -np.cos(elevation) * np.sin(azimuth)))
    eye = np.array((0.5, 0.7, 3.2)) if view == View() else -view.distance * sight
    center = view.center
    height = float(episode.body[:, 2].max()) * 0.6 if center is None else center[2]
    return {"eye": _rounded(eye), "center": center and [*center[:2]], "eye_height": round(height, 3)}


def _inside_script(text: str) -> str:
    """Escape JavaScript so that it cannot close the `<script>` element around it."""
    return re.sub("</(?=script)", r"<\\/", text, flags=re.IGNORECASE)


def _body_poses(episode: Episode) -> np.ndarray:
    """Position and quaternion of every body after every step, `[T, nbody, 7]`; three.js orders it x, y, z, w."""
    model = episode.model
    data = mujoco.MjData(model)
    poses = np.zeros((len(episode.qpos), model.nbody, 7))
    for pose, qpos in zip(poses, episode.qpos, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        pose[:, :3] = data.xpos
        pose[:, 3:] = data.xquat[:, [1, 2, 3, 0]]
    return poses


def _geoms(model: mujoco.MjModel) -> list[dict[str, object]]:
    """The visible geoms, without planes, height fields and signed distance functions."""
    geoms = []
    for i in range(model.ngeom):
        shape = mujoco.mjtGeom(model.geom_type[i]).name.removeprefix("mjGEOM_").lower()
        rgba = model.mat_rgba[model.geom_matid[i]] if model.geom_matid[i] >= 0 else model.geom_rgba[i]
        if shape not in _SHAPES or model.geom_group[i] >= _NUM_VISIBLE_GROUPS or rgba[3] == 0:
            continue
        geom = {
            "type": shape,
            "body": int(model.geom_bodyid[i]),
            "size": _rounded(model.geom_size[i]),
            "pos": _rounded(model.geom_pos[i]),
            "quat": _rounded(model.geom_quat[i][[1, 2, 3, 0]]),
            "rgba": _rounded(rgba),
        }
        geoms.append(geom | (_mesh(model, int(model.geom_dataid[i])) if shape == "mesh" else {}))
    return geoms


def _mesh(model: mujoco.MjModel, mesh: int) -> dict[str, list]:
    """Vertices of a mesh, three numbers each, and its triangles, three vertex indices each."""
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    return {
        "vertices": _rounded(model.mesh_vert[vertices].ravel()),
        "faces": model.mesh_face[faces].ravel().tolist(),
    }


def _rounded(values: np.ndarray, digits: int = 5) -> list[float]:
    return [round(float(value), digits) for value in values]
