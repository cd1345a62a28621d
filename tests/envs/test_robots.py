"""Robots from model files: what is added, the standing pose, and the feet."""

import mujoco
import numpy as np
import pytest
from small_robot import BENT, small_robot, write

from mjx_walk.envs.robots.completion import complete
from mjx_walk.envs.robots.robot import load_robot
from mjx_walk.envs.robots.servos import Motors
from mjx_walk.envs.robots.surfaces import heights, surface
from mjx_walk.utils.errors import UserError

FLOOR = '<geom name="ground" type="plane" size="1 1 1" pos="0 0 0.3"/>'
MOTOR = 'motor ctrlrange="-2 2" gear="5"'
OTHER_BODY = '<body><freejoint/><geom size="0.1"/></body>'


def loaded(folder, feet=(), motors=None, **options):
    return load_robot(write(folder, small_robot(**options)), motors or Motors(), feet)


def gains_of(robot):
    """kp and kd of each servo."""
    return robot.model.actuator_gainprm[:, 0], -robot.model.actuator_biasprm[:, 2]


def names_of(robot):
    """The body of each foot."""
    return [robot.model.body(robot.model.geom_bodyid[foot.geoms[0]]).name for foot in robot.feet]


def test_a_bare_robot_gets_a_floor_and_servos(tmp_path, caplog):
    caplog.set_level("INFO")
    robot = loaded(tmp_path)
    model = robot.model
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).sum() == 1 and robot.floor == 0.0
    np.testing.assert_array_equal(model.actuator_ctrlrange, 4 * [[-1.5, 1.5], [-2.5, -0.5]])
    np.testing.assert_array_equal(model.actuator_forcerange, 8 * [[-20, 20]])
    np.testing.assert_allclose(robot.targets, 4 * BENT)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 4 and all("\n" not in line for line in lines)
    assert lines[0].endswith("robot.xml has no floor: added one at height 0")
    assert lines[1].startswith("The model has no motors: added position servos to its hinges (8; kp ")
    assert lines[1].endswith(" at most 20 N·m); env.motors changes them")
    assert lines[2:] == [
        "The robot stands in the keyframe 'home'",
        "Feet: FL_shin, FR_shin, RL_shin, RR_shin",
    ]


def test_motors_of_torque_become_servos_with_their_limits(tmp_path):
    robot = loaded(tmp_path, before=FLOOR, joint='armature="0.005"')
    assert robot.floor == 0.3 and (robot.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).sum() == 1
    assert not robot.model.actuator_forcelimited.any()
    text = small_robot(actuator=MOTOR, joint='armature="0.005"')
    robot = load_robot(write(tmp_path, text), Motors())
    np.testing.assert_array_equal(robot.model.actuator_forcerange, 8 * [[-10, 10]])
    np.testing.assert_array_equal(robot.model.actuator_gear[:, 0], 1.0)
    np.testing.assert_array_equal(robot.model.actuator_ctrlrange[0], [-1.5, 1.5])


def test_a_robots_own_servos_stay(tmp_path):
    text = small_robot(actuator='position kp="31" kv="0.7"')
    model = complete(write(tmp_path, text), Motors(kp=5.0)).model
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], 31.0)
    np.testing.assert_array_equal(model.actuator_biasprm[:, :3], 8 * [[0.0, -31.0, -0.7]])
    np.testing.assert_array_equal(model.actuator_ctrlrange, 4 * [[-1.5, 1.5], [-2.5, -0.5]])  # of the joints


def test_gains_are_settings_and_grow_with_the_robot(tmp_path):
    given = loaded(tmp_path, motors=Motors(kp=50.0, kd=1.5, torque=9.0))
    np.testing.assert_array_equal(gains_of(given), [8 * [50.0], 8 * [1.5]])
    np.testing.assert_array_equal(given.model.actuator_forcerange, 8 * [[-9, 9]])
    small = loaded(tmp_path, joint="")
    large = loaded(tmp_path, joint="", scale=2.0)
    kp, kd = gains_of(small)
    np.testing.assert_allclose(gains_of(large)[0], 16 * kp, rtol=1e-6)  # weight times length
    assert (gains_of(large)[1] > 8 * kd).all()


def test_joints_without_an_armature_get_that_of_a_servo_of_10_hz(tmp_path):
    bare = loaded(tmp_path, joint="")
    expected = gains_of(bare)[0] / (2 * np.pi * 10) ** 2
    np.testing.assert_allclose(bare.model.dof_armature[bare.velocities], expected, rtol=1e-6)
    assert (loaded(tmp_path).model.dof_armature[6:] == 0.005).all()  # the file's
    assert (loaded(tmp_path, motors=Motors(armature=0.02)).model.dof_armature[6:] == 0.02).all()


def test_servos_reach_their_targets_without_oscillating(tmp_path):
    """A quarter of a second after a step of 0.2 rad, with the robot hanging."""
    robot = loaded(tmp_path, joint='armature="0.005"')
    model, data = robot.model, mujoco.MjData(robot.model)
    model.opt.gravity[:] = 0.0
    data.qpos[:] = robot.standing
    data.qpos[2], data.qpos[robot.positions], data.ctrl[:] = 5.0, robot.targets, robot.targets + 0.2
    mujoco.mj_step(model, data, nstep=round(0.25 / model.opt.timestep))
    np.testing.assert_allclose(data.qpos[robot.positions], data.ctrl, atol=0.05)


def test_the_standing_pose_is_at_rest_on_the_floor(tmp_path):
    robot = loaded(tmp_path, before=FLOOR)
    data = mujoco.MjData(robot.model)
    data.qpos[:], data.ctrl[:] = robot.standing, robot.targets
    mujoco.mj_step(robot.model, data, nstep=250)
    assert abs(data.qpos[2] - robot.standing[2]) < 2e-3 and data.xmat[robot.root, 8] > 0.999
    assert 0.2 < robot.standing[2] - robot.floor < 0.27


@pytest.mark.parametrize(
    ("angles", "found"),
    [
        (BENT, "The robot stands in the keyframe 'home'"),
        ((-1.5, -0.5), "The robot stands in the model's own pose"),  # legs ahead: it tips over
        (None, "The robot stands in the model's own pose"),
    ],
)
def test_a_keyframe_that_does_not_stand_is_replaced(tmp_path, caplog, angles, found):
    caplog.set_level("INFO")
    robot = loaded(tmp_path, angles=angles)
    lines = [record.getMessage() for record in caplog.records]
    assert any(line.startswith(found) for line in lines), lines
    assert ("The robot does not stand for a second in the keyframe 'home'" in lines) == (angles == (-1.5, -0.5))
    assert len(robot.feet) == 4


def test_a_robot_that_cannot_stand_is_refused(tmp_path):
    with pytest.raises(UserError, match="the robot stands neither in a keyframe nor in the model's own pose; add a"):
        loaded(tmp_path, motors=Motors(torque=0.05))


def test_feet_are_found_or_named(tmp_path):
    assert names_of(loaded(tmp_path)) == ["FL_shin", "FR_shin", "RL_shin", "RR_shin"]
    named = loaded(tmp_path, feet=("RR", "FL_shin"))
    assert [len(set(foot.geoms)) for foot in named.feet] == [1, 2] and names_of(named) == ["RR_shin", "FL_shin"]
    with pytest.raises(UserError, match=r"env.feet: the model has no geom or body 'FL_shim'; did you mean: FL_shin"):
        loaded(tmp_path, feet=("FL_shim",))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            {"root": "", "angles": None},
            "robot.xml has no free joint, so it cannot walk; add <freejoint/> to the robot's root body",
        ),
        ({"before": OTHER_BODY, "angles": None}, "the body '1' of .*, the first with a free joint, has no hinge"),
        (
            {"before": '<body><joint/><geom size="1"/></body>', "angles": None},
            "first joint of .* is not the robot's free",
        ),
        (
            {"actuator": 'velocity kv="1" ctrlrange="-1 1"'},
            "motor '0' of the model is neither a <position> servo nor a",
        ),
    ],
)
def test_what_cannot_walk_is_refused_in_one_line(tmp_path, options, says):
    with pytest.raises(UserError, match=says) as error:
        loaded(tmp_path, **options)
    assert "\n" not in str(error.value)


GEOMS = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 3"><freejoint/>
      <geom type="sphere" size="0.3"/><geom type="capsule" size="0.1 0.4"/><geom type="box" size="0.1 0.2 0.3"/>
      <geom type="mesh" mesh="wedge"/><geom type="cylinder" size="0.2 0.3"/><geom type="ellipsoid" size="0.1 0.2 0.3"/>
    </body>
  </worldbody>
</mujoco>"""


def test_the_lowest_point_is_mujocos_distance_to_the_floor():
    """Exact for spheres, capsules, boxes and meshes; within 4% of the size for cylinders and ellipsoids."""
    model = mujoco.MjModel.from_xml_string(GEOMS)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(50):
        data.qpos[3:7] = rng.normal(size=4)
        mujoco.mj_forward(model, data)
        for geom in range(1, model.ngeom):
            found = heights(surface(model, np.array([geom])), data.geom_xpos, data.geom_xmat).min()
            expected = mujoco.mj_geomDistance(model, data, 0, geom, 10.0, None)
            assert abs(found - expected) < (1e-6 if geom < 5 else 0.04 * model.geom_rbound[geom]), model.geom_type[geom]
