"""Every array of `mjData` equals MuJoCo's at Gymnasium's moment, or is refused by name before compilation."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from derived_arrays import MODELS, TOLERANCE, accepted, array_names, errors, reference_cases
from helpers import slow_except
from mujoco.mjx._src import smooth as mjx_smooth
from rich_model import sensors

from mjx_walk.envs.physics import ENGINES, PhysicsState, make_engine
from mjx_walk.envs.physics.derived_arrays import refuse_derived
from mjx_walk.utils.errors import UserError

PENDULUM = """
<mujoco>
  <option timestep="0.004" {option}/>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body pos="0 0 .3">
      <joint axis="0 1 0" damping=".2"/>
      <geom type="capsule" size=".05" fromto="0 0 0 .2 0 0" contype="0" conaffinity="0"/>
      <body pos=".2 0 0">
        <joint axis="0 1 0"/><geom type="sphere" size=".1" pos=".2 0 -.2"/><site name="tip" pos=".2 0 -.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="joint" ctrlrange="-1 1"/></actuator>
  <sensor>{sensor}</sensor>
</mujoco>
""".replace("<joint axis", '<joint name="joint" axis', 1)
"""Two links, of which the second touches the floor."""
HINGE = """
<mujoco>
  <worldbody>
    <body pos="0 0 1">
      <joint name="joint" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/><site name="tip" pos=".2 0 0"/>
    </body>
  </worldbody>
  <actuator><motor joint="joint" ctrlrange="-1 1"/></actuator>
  <sensor><accelerometer site="tip"/><force site="tip"/><torque site="tip"/></sensor>
</mujoco>
"""
FREE_BODY = '<mujoco><worldbody><body><freejoint/><geom type="sphere" size=".1"/></body></worldbody></mujoco>'
BODY_ON_A_FLOOR = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="body" pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <sensor><contact name="feet" subtree1="body" reduce="{reduce}" data="{data}"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize("name", ["spatial_tendon", "force_sensors_rk4"])
def test_arrays_of_the_c_engine_equal_gymnasiums(name):
    model = MODELS[name]()
    names = tuple(accepted(model, "c", array_names(model)))
    assert len(names) > 70
    found = errors(model, "c", names, reference_cases(model))
    assert {array: error for array, error in found.items() if max(error) > TOLERANCE["c"]} == {}


@pytest.mark.parametrize(
    ("option", "sensor"),
    [('integrator="Euler"', ""), pytest.param('integrator="RK4"', '<force site="tip"/>', marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("engine", ["jax", pytest.param("warp", marks=pytest.mark.slow)])
def test_late_arrays_equal_mujocos(engine, option, sensor):
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(option=option, sensor=sensor))
    cases = reference_cases(model)
    assert all(np.abs(case.step["cfrc_ext"]).max() > 1 for case in cases)
    assert all(case.reset["cfrc_int"].any() == bool(sensor) for case in cases)
    found = errors(model, engine, ("cacc", "cfrc_int"), cases)
    assert {name: error for name, error in found.items() if max(error) > TOLERANCE[engine]} == {}


def test_programs_without_late_arrays_do_not_compute_them(monkeypatch):
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(option="", sensor=""))
    state = PhysicsState(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
    monkeypatch.setattr(mjx_smooth, "rne_postconstraint", None)
    jax.eval_shape(make_engine("jax", model, 2, ("xpos", "qfrc_constraint")).step, state, jnp.zeros(1))


@pytest.mark.slow
def test_a_reset_returns_the_given_quaternion():
    model = mujoco.MjModel.from_xml_string(FREE_BODY)
    qpos = jnp.float32([0, 0, 1, 2, 0, 0, 0])
    engine = make_engine("jax", model, 1, ("qpos",))
    state = PhysicsState(qpos, jnp.zeros(6), jnp.zeros(6))
    np.testing.assert_array_equal(jax.jit(engine.forward)(state)["qpos"], qpos)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_array_is_accepted_or_refused_in_one_line(engine):
    """`accepted` checks the error of each array that it leaves out."""
    model = MODELS["spatial_tendon"]()
    names = array_names(model)
    found = set(accepted(model, engine, names))
    assert {"xpos", "cinert", "qfrc_constraint", "cacc"} <= found
    assert not found & {"contact", "time", "efc_force", "efc_J", "efm_L", "tree_island", "wrap_xpos", "solver_niter"}
    assert ({"cfrc_ext", "cfrc_int"} <= found) == (engine != "jax")
    assert ({"qLD", "energy", "flexvert_xpos"} <= found) == (engine == "c")
    assert ({"M", "ten_J", "light_xpos"} <= found) == (engine != "jax")


@pytest.mark.parametrize(
    ("engine", "model", "name", "says"),
    [
        ("c", "floor", "efc_force", "no engine returns mjData's 'efc_force'"),
        ("c", "floor", "contact", "no engine returns mjData's 'contact'"),
        ("c", "floor", "time", "mjData's 'time' depends on earlier steps"),
        ("c", "floor", "xpo", "mjData has no array 'xpo' (did you mean: xpos"),
        ("jax", "floor", "qLD", "physics=jax does not return mjData's 'qLD' as MuJoCo does; use physics=c"),
        ("jax", "floor", "ten_J", "physics=jax does not return mjData's 'ten_J' as MuJoCo does; use physics=warp or c"),
        (
            *("jax", "fluid", "qfrc_fluid"),
            "physics=jax does not return mjData's 'qfrc_fluid' as MuJoCo does; use physics=warp or c",
        ),
        ("warp", "floor", "energy", "physics=warp does not return mjData's 'energy' as MuJoCo does; use physics=c"),
        # Wrong on a GPU only: there, threads race for the rows.
        *(
            ("warp", "humanoid", name, f"physics=warp does not return mjData's '{name}' as MuJoCo does; use physics=c")
            for name in ("actuator_moment", "moment_rowadr", "moment_colind")
        ),
        ("jax", "spatial_tendon", "cfrc_ext", "physics=jax leaves the forces of spatial tendons out of 'cfrc_ext'"),
        ("jax", "subtree_sensors_rk4", "subtree_linvel", "MJX computes sensors at another stage of RK4"),
        ("warp", "activation_rk4", "act_dot", "physics=warp returns another 'act_dot' than MuJoCo with RK4"),
        ("warp", "force_sensors_rk4", "sensordata", "MJX computes sensors at another stage of RK4"),
    ],
)
def test_refusals(engine, model, name, says):
    with pytest.raises(UserError) as refused:
        make_engine(engine, MODELS[model](), 1, ("xpos", name))
    assert says in str(refused.value) and f"the task names '{name}' in derived_names" in str(refused.value)


def test_jax_refuses_late_arrays_without_constraints():
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(option="", sensor=""))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    refuse_derived(model, "jax", ("xpos",))
    with pytest.raises(UserError, match="does not compute 'cacc' without constraints; remove the flag"):
        refuse_derived(model, "jax", ("cacc",))


def test_sensors_of_accelerations_without_any_constraint():
    """MJX leaves them out where the solver has nothing to do."""
    model = mujoco.MjModel.from_xml_string(HINGE)
    assert not mujoco.mjx.make_data(model)._impl.efc_J.size
    found = errors(model, "jax", ("sensordata", "cacc", "cfrc_int"), reference_cases(model))
    assert max(max(pair) for pair in found.values()) < TOLERANCE["jax"]


@pytest.mark.parametrize(
    ("engine", "kind", "says"),
    [
        *((engine, "clock", "sensor '1' reads the time") for engine in ENGINES),
        ("warp", "fromto", "physics=warp computes sensor '1' otherwise than MuJoCo"),
        ("jax", "contact", "physics=jax computes sensor '1' otherwise than MuJoCo"),
    ],
)
def test_sensors_are_refused_where_the_task_reads_them(engine, kind, says):
    with pytest.raises(UserError, match=says):
        make_engine(engine, sensors("jointpos", kind), 1, ("sensordata",))


def test_warp_refuses_contact_sensors_whose_order_is_left_to_chance():
    def read(engine, reduce, data):
        model = mujoco.MjModel.from_xml_string(BODY_ON_A_FLOOR.format(reduce=reduce, data=data))
        refuse_derived(model, engine, ("sensordata",))

    read("c", "none", "found force")
    with pytest.raises(UserError, match="contacts of sensor 'feet' in no fixed order; set its reduce"):
        read("warp", "none", "found force")
    for reduce, data in (("none", "found"), ("maxforce", "force"), ("netforce", "force")):
        read("warp", reduce, data)


ACTIVATED = PENDULUM.replace(
    "</actuator>",
    '<general name="joint" joint="joint" dyntype="filter" dynprm=".05" ctrlrange="-1 1"/>'
    '<general joint="joint" dyntype="integrator" gaintype="affine" gainprm="1 0 -.5" ctrlrange="-1 1"/></actuator>',
)
ACTIVATION_CASES = ["c implicit", "c implicitfast", "c RK4", "jax RK4", "warp implicitfast"]
MOMENT_ARRAYS = ("qpos", "qacc", "act", "act_dot", "actuator_force", "qfrc_actuator", "cvel", "cacc", "sensordata")
"""Arrays that tell the start of the last substep from its end, or from another stage."""


@pytest.mark.parametrize("case", slow_except(["c implicit", "c RK4"], ACTIVATION_CASES))
def test_arrays_with_activations_equal_mujocos(case):
    engine, integrator = case.split()
    sensor = '<actuatorfrc actuator="joint"/><accelerometer site="tip"/>'
    model = mujoco.MjModel.from_xml_string(ACTIVATED.format(option=f'integrator="{integrator}"', sensor=sensor))
    names = [name for name in MOMENT_ARRAYS if case != "jax RK4" or name != "sensordata"]  # refused
    cases = reference_cases(model)
    assert all(np.abs(case.step["act"]).min() > 0 and np.abs(case.step["act_dot"]).min() > 0 for case in cases)
    found = errors(model, engine, tuple(names), cases)
    assert {name: error for name, error in found.items() if max(error) > TOLERANCE[engine]} == {}
