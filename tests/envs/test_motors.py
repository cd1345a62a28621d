"""What motors move, against MuJoCo's own moments, for all its transmissions."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_walk.envs import make_env
from mjx_walk.envs.motors import motor_dofs, moved_joints, torques_per_force
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.envs.reward_shaping import RewardStep, Shaping, check_shaping, shaping_terms
from mjx_walk.utils.errors import UserError

BODIES = """
<mujoco>
  <worldbody>
    <site name="world"/>
    <body name="torso">
      <freejoint name="root"/>
      <geom size="0.1"/>
      <site name="torso"/>
      <site name="front" pos="2 0 0"/>
      <body pos="1 0 0">
        <joint name="ball" type="ball"/>
        <geom name="knuckle" size="0.1" pos="0 0.03 0"/>
        <site name="arm" pos="0.1 0.2 0.3"/>
        <body pos="1 0 0">
          <joint name="hinge" axis="0 1 0"/>
          <geom size="0.1"/>
          <site name="hand" pos="0.1 0.2 0.3"/>
        </body>
      </body>
      <body name="foot" pos="-1 0 0">
        <joint name="slide" type="slide" axis="0 1 1"/>
        <joint name="twist" axis="1 0 0"/>
        <geom name="ankle" size="0.05"/>
        <site name="foot" pos="0.1 0.2 0.3"/>
      </body>
      <body pos="0 0 1"><joint name="idle"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="fixed"><joint joint="hinge" coef="1"/><joint joint="slide" coef="-2"/></fixed>
    <spatial name="spatial"><site site="hand"/><site site="arm"/><geom geom="ankle"/><site site="foot"/></spatial>
    <spatial name="around"><site site="torso"/><geom geom="knuckle"/><site site="front"/></spatial>
    <spatial name="pulley">
      <site site="hand"/><site site="arm"/><pulley divisor="2"/><site site="torso"/><site site="foot"/>
    </spatial>
    <fixed name="zero"><joint joint="hinge" coef="1"/><joint joint="slide" coef="0"/></fixed>
  </tendon>
  <actuator>{}</actuator>
</mujoco>
"""
MOVED = {
    '<motor joint="hinge"/>': {"hinge"},
    '<motor joint="slide" gear="-3"/>': {"slide"},
    '<motor joint="ball" gear="0 -2 0"/>': {"ball"},
    '<motor joint="root" gear="0 0 3 0 0 4"/>': {"root"},
    '<motor jointinparent="ball" gear="0 1 1"/>': {"ball"},
    '<motor jointinparent="hinge"/>': {"hinge"},
    '<motor jointinparent="root" gear="0 0 0 1 0 0"/>': {"root"},
    '<motor tendon="fixed" gear="2"/>': {"hinge", "slide"},
    '<motor tendon="spatial"/>': {"ball", "hinge", "slide", "twist"},
    '<motor tendon="around"/>': {"ball"},
    '<motor tendon="pulley"/>': {"hinge", "slide", "twist"},
    '<motor tendon="zero"/>': {"hinge"},
    '<motor site="torso" gear="1 1 1 0 0 0"/>': {"root"},
    '<motor site="hand" gear="1 1 1 1 1 1"/>': {"root", "ball", "hinge"},
    '<motor site="hand" refsite="foot" gear="1 1 1 1 1 1"/>': {"ball", "hinge", "slide", "twist"},
    '<motor site="hand" refsite="torso" gear="1 1 1 1 1 1"/>': {"ball", "hinge"},
    '<general cranksite="hand" slidersite="foot" cranklength="9"/>': {"ball", "hinge", "slide", "twist"},
    '<general cranksite="foot" slidersite="world" cranklength="9"/>': {"root", "slide", "twist"},
    '<adhesion body="foot" ctrlrange="0 1"/>': set(),
}


def load(motors):
    model = mujoco.MjModel.from_xml_string(BODIES.format(motors))
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("motor", MOVED)
def test_moved_joints_are_those_with_a_moment(motor):
    model, data = load(motor)
    rng = np.random.default_rng(0)
    has_moment = np.zeros(model.njnt, bool)
    for _ in range(3):
        data.qpos[:] = rng.normal(size=model.nq) * 0.3
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        moment = np.zeros((1, model.nv))
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        has_moment[model.dof_jntid[np.abs(moment[0]) > 1e-9]] = True
    found = {model.joint(joint).name for joint in moved_joints(model, 0)}
    assert found == MOVED[motor] == {model.joint(int(joint)).name for joint in np.flatnonzero(has_moment)}
    axes = [dof for dof in range(model.nv) if model.joint(int(model.dof_jntid[dof])).name in MOVED[motor]]
    np.testing.assert_array_equal(motor_dofs(model), axes)


@pytest.mark.parametrize("motor", [motor for motor in MOVED if "joint=" in motor])
def test_torques_are_those_on_the_joint(motor):
    model, data = load(motor)
    data.ctrl[:] = 0.7
    mujoco.mj_forward(model, data)
    applied = data.qfrc_actuator[motor_dofs(model)]
    found = torques_per_force(model)[0] * data.actuator_force[0]
    assert abs(found) == pytest.approx(np.linalg.norm(applied))
    assert np.sign(found) == np.sign(applied[np.abs(applied).argmax()])


def test_shaking_counts_every_axis_once():
    """Three motors on one ball joint move its three axes; a fourth one moves the hinge."""
    axes = "".join(f'<motor joint="ball" gear="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    model, _ = load(f'{axes}<motor jointinparent="hinge"/>')
    qvel = jnp.arange(model.nv, dtype=jnp.float32)
    physics = PhysicsState(jnp.zeros(model.nq), qvel, qvel)
    step = RewardStep({}, jnp.zeros(()), physics, physics, qvel, qvel, jnp.zeros((), bool), 0.1)
    terms = shaping_terms(Shaping(shaking=0.5), step, motor_dofs(model))
    assert float(terms["reward_shaking"]) == pytest.approx(-0.5 * np.mean(np.square([6, 7, 8, 9])))


def test_a_task_counts_the_joints_of_a_tendon(tmp_path):
    model = tmp_path / "tendon.xml"
    model.write_text(
        '<mujoco><worldbody><body><joint name="a" type="slide"/><geom size="1"/><body><joint name="b"/>'
        '<geom size="1"/></body></body></worldbody><tendon><fixed name="t"><joint joint="b" coef="1"/></fixed></tendon>'
        "<actuator>{}</actuator></mujoco>".format('<motor tendon="t" ctrlrange="-1 1"/>')
    )
    task = make_env("inverted_pendulum", physics="c", xml_file=str(model), shaping={"shaking": 1.0})
    assert task._motor_dofs.tolist() == [1]


def test_motors_that_move_no_joint_are_refused():
    model, _ = load('<adhesion body="foot" ctrlrange="0 1"/>')
    with pytest.raises(UserError, match=r"env\.shaping\.shaking=0\.1: robot has no motor that moves a joint; set it"):
        check_shaping(Shaping(shaking=0.1), "robot", True, True, motor_dofs(model).size > 0, True)
