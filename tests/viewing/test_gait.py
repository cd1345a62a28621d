"""What gait sheets group and name."""

import mujoco
import pytest

import mjx_walk
from mjx_walk.viewing.gait import _body_name, _limb_and_name

LIMBS = {
    "humanoid": ["lwaist", "right_thigh", "left_thigh", "right_upper_arm", "left_upper_arm"],
    "walker2d": ["thigh", "thigh_left"],
    "ant": ["right_back_leg", "front_left_leg", "front_right_leg", "back_leg"],
    "hopper": ["torso"],
}


@pytest.mark.parametrize("name", LIMBS)
def test_motors_are_grouped_by_limb(name):
    model = mjx_walk.make_env(name, physics="c").model
    found = [_limb_and_name(model, motor) for motor in range(model.nu)]
    assert list(dict.fromkeys(limb for limb, _ in found)) == LIMBS[name]
    assert len({motor for _, motor in found}) == model.nu


def test_a_body_without_a_name_is_called_after_the_one_it_belongs_to():
    model = mjx_walk.make_env("ant", physics="c").model
    feet = [body for body in range(model.nbody) if not model.body(body).name]
    assert {_body_name(model, body) for body in feet} == {f"part of aux_{i}" for i in (1, 2, 3, 4)}


def test_a_motor_that_drives_no_joint_has_no_limb():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j'/><geom size='1'/><site name='s'/></body></worldbody>"
        "<actuator><general site='s'/></actuator></mujoco>"
    )
    assert _limb_and_name(model, 0) == ("other motors", "motor 0")


def test_each_motor_of_a_joint_has_a_name_of_its_own():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='b'><joint name='j' type='ball'/><geom size='1'/></body></worldbody><actuator>"
        "<motor joint='j' gear='1 0 0'/><motor jointinparent='j' gear='0 1 0'/></actuator></mujoco>"
    )
    assert [_limb_and_name(model, motor) for motor in (0, 1)] == [("b", "motor 0"), ("b", "motor 1")]
