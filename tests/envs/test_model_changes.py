"""Every value of a model is appearance, which no simulation depends on, or its changes are refused."""

import fnmatch

import jax
import mujoco
import numpy as np
import pytest

from mjx_walk.envs import make_env
from mjx_walk.envs.model_changes import APPEARANCE, ModelSnapshot
from mjx_walk.utils.errors import UserError

# A body of every kind of element: meshes, height fields, tendons, sites, cameras, textures, keyframes, custom values.
MODEL = """
<mujoco>
  <asset>
    <mesh name="pyramid" vertex="0 0 0  1 0 0  0 1 0  0 0 1" texcoord="0 0 1 0 0 1 1 1" scale="0.2 0.2 0.2"/>
    <hfield name="hills" nrow="3" ncol="3" elevation="0 1 0 1 0 1 0 1 0" size="2 2 0.1 0.1"/>
    <texture name="checks" type="2d" builtin="checker" width="8" height="8" rgb1="1 0 0"/>
    <material name="checked" texture="checks"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="side" pos="0 -3 1"/>
    <geom type="hfield" hfield="hills"/>
    <body name="ball" pos="0 0 0.4">
      <freejoint/>
      <geom name="stone" type="mesh" mesh="pyramid" material="checked" user="1"/>
      <body pos="0.3 0 0">
        <joint name="hinge" axis="0 1 0" damping="0.1" stiffness="1" springref="0.3" range="-1 1" limited="true"/>
        <geom size="0.1 0.2" type="capsule"/>
        <site name="tip" pos="0 0 0.2"/>
      </body>
    </body>
    <body mocap="true" pos="3 0 1"><geom size="0.1" contype="0" conaffinity="0"/><site name="far"/></body>
  </worldbody>
  <tendon><spatial name="rope" stiffness="1"><site site="tip"/><site site="far"/></spatial></tendon>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/><motor tendon="rope" ctrlrange="-1 1"/></actuator>
  <equality><joint joint1="hinge" active="false"/></equality>
  <contact><pair geom1="stone" geom2="stone"/></contact>
  <sensor><touch site="tip"/></sensor>
  <custom><numeric name="n" data="1 2"/><tuple name="t"><element objtype="site" objname="tip"/></tuple></custom>
  <keyframe><key/></keyframe>
</mujoco>
"""
IN_PLACE = {
    "qpos_spring": lambda model: model.qpos_spring.__setitem__(-1, 0.2),
    "geom_friction": lambda model: model.geom("stone").friction.__setitem__(0, 2.0),
    "jnt_range": lambda model: model.joint("hinge").range.__setitem__(0, -0.5),
    "actuator_gear": lambda model: model.actuator("motor").gear.__setitem__(0, 3.0),
    "hfield_data": lambda model: model.hfield_data.__setitem__(0, 0.5),
    "mesh_vert": lambda model: model.mesh_vert.__setitem__((0, 0), 0.5),
    "key_qpos": lambda model: model.key_qpos.__setitem__((0, 0), 0.5),
    "opt.disableflags": lambda model: setattr(model.opt, "disableflags", int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)),
    "opt.gravity": lambda model: model.opt.gravity.__setitem__(2, -1.6),
    "opt.timestep": lambda model: setattr(model.opt, "timestep", 0.01),
    "opt.wind": lambda model: setattr(model, "opt", mujoco.MjModel.from_xml_string(WINDY).opt),
    "stat.meaninertia": lambda model: setattr(model.stat, "meaninertia", 9.0),
}
WINDY = '<mujoco><option wind="1 0 0"/></mujoco>'


def load():
    return mujoco.MjModel.from_xml_string(MODEL)


def names_of(model):
    """All values that can be changed."""
    arrays = [name for name in dir(model) if not name.startswith("_") and np.size(getattr(model, name)) > 0]
    found = [name for name in arrays if isinstance(getattr(model, name), np.ndarray)]
    for part in ("opt", "stat"):
        found += [f"{part}.{name}" for name in dir(getattr(model, part)) if not name.startswith("_")]
    return found


def is_appearance(name):
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in APPEARANCE)


def change(model, name):
    """Change a value, and return a function that restores it."""
    owner, _, attribute = f".{name}".rpartition(".")
    owner = getattr(model, owner[1:]) if owner[1:] else model
    value = getattr(owner, attribute)
    if isinstance(value, np.ndarray):
        former = value.copy()
        value[...] = value == 0 if value.dtype == bool else value + 1
        return lambda: value.__setitem__(..., former)
    setattr(owner, attribute, value + 1)
    return lambda: setattr(owner, attribute, value)


def test_every_value_is_watched_or_appearance():
    model = load()
    snapshot = ModelSnapshot(model)
    names = names_of(model)
    assert len(names) > 250
    for name in names:
        restore = change(model, name)
        if is_appearance(name):
            snapshot.refuse_changes()
        else:
            with pytest.raises(UserError, match=f"model.{name}; "):
                snapshot.refuse_changes()
        restore()
    snapshot.refuse_changes()


@pytest.mark.parametrize(
    ("name", "derived", "is_refused"),
    [
        ("cam_pos", ("qfrc_passive",), False),
        ("cam_pos", ("cam_xpos",), True),
        ("cam_fovy", ("sensordata",), True),
        ("geom_rgba", ("cam_xpos",), False),
        ("geom_rgba", ("sensordata",), True),
        ("light_pos", ("light_xpos",), True),
        ("light_pos", ("sensordata",), False),
    ],
)
def test_appearance_that_a_task_reads_is_watched(name, derived, is_refused):
    model = load()
    snapshot = ModelSnapshot(model, derived)
    change(model, name)
    if not is_refused:
        return snapshot.refuse_changes()
    with pytest.raises(UserError, match=f"model.{name}; "):
        snapshot.refuse_changes()


def test_the_physics_does_not_depend_on_appearance():
    def trajectory(model):
        data = mujoco.MjData(model)
        data.ctrl[:] = 0.5
        mujoco.mj_step(model, data, nstep=200)
        return np.concatenate([data.qpos, data.qvel, data.sensordata])

    expected = trajectory(load())
    for name in filter(is_appearance, names_of(load())):
        if name.endswith(("id", "adr", "num")):  # an index beyond the model's end
            continue
        model = load()
        change(model, name)
        np.testing.assert_array_equal(trajectory(model), expected, err_msg=name)
    assert not np.array_equal(trajectory(mujoco.MjModel.from_xml_string(MODEL.replace("0.3", "0.31"))), expected)


@pytest.mark.parametrize("name", IN_PLACE)
def test_changes_through_views_are_seen(name):
    model = load()
    snapshot = ModelSnapshot(model)
    IN_PLACE[name](model)
    with pytest.raises(UserError, match=f"the physics ignores your change to model.{name}; use xml_file=PATH instead"):
        snapshot.refuse_changes()


def test_a_task_refuses_a_changed_model():
    task = make_env("inverted_pendulum", physics="c")
    key, action = jax.random.PRNGKey(0), np.zeros(1, np.float32)
    state = jax.eval_shape(task.reset, key)
    task.model.geom_rgba[:] = 1.0
    jax.eval_shape(task.step, state, action)
    task.model.body_mass[1] *= 2.0
    for method, arguments in ((task.reset, (key,)), (task.step, (state, action))):
        with pytest.raises(UserError, match=r"ignores your change to model\.body_mass"):
            jax.eval_shape(method, *arguments)
