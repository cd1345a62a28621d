"""Run an exported policy in MuJoCo: python run_robot.py POLICY.onnx ROBOT.xml [FORWARD [LEFT [TURN]]].

The numbers are the commanded velocities, m/s and rad/s. It needs only mujoco, numpy and onnxruntime.
"""

import json
import sys

import mujoco
import numpy as np
import onnxruntime

TEXTS = ("task", "algorithm", "policy", "mjx_walk")
"""Metadata that are not JSON."""


def load_model(path, facts):
    """The robot with the servos of its training, and with a floor if its file has none."""
    spec = mujoco.MjSpec.from_file(path)
    servos = list(spec.actuators) or [spec.add_actuator() for _ in facts["joint_names"]]
    for i, (servo, name) in enumerate(zip(servos, facts["joint_names"], strict=True)):
        spec.joint(name).armature = facts["joint_armature"][i]
        servo.target, servo.trntype, servo.gear[0] = name, mujoco.mjtTrn.mjTRN_JOINT, 1.0
        servo.set_to_position(kp=facts["joint_stiffness"][i], kv=facts["joint_damping"][i])
        servo.ctrllimited, servo.ctrlrange = True, facts["joint_pos_limits"][i]
        torque = facts["joint_torque_limits"][i]
        servo.forcelimited, servo.forcerange = torque is not None, [-(torque or 0.0), torque or 0.0]
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[20, 20, 0.05], contype=1, conaffinity=1)
    return spec.compile()


def walk(policy_path, model_path, command, num_steps):
    """Let the robot walk under a command, and yield each observation with the state that follows."""
    policy = onnxruntime.InferenceSession(policy_path)
    texts = policy.get_modelmeta().custom_metadata_map
    facts = {name: json.loads(text) for name, text in texts.items() if name not in TEXTS}
    model = load_model(model_path, facts)
    data = mujoco.MjData(model)
    data.qpos[:] = facts["default_qpos"]
    joints = model.actuator_trnid[:, 0]
    positions, velocities = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    standing, gravity = np.array(facts["default_joint_pos"]), np.zeros(3)
    senses = {"last_action": np.zeros(model.nu), "command": command}
    for _ in range(num_steps):
        mujoco.mju_rotVecQuat(gravity, np.array([0.0, 0.0, -1.0]), data.qpos[3:7] * [1, -1, -1, -1])
        senses |= {"angular_velocity": data.qvel[3:6], "gravity": gravity}
        senses |= {"joint_positions": data.qpos[positions] - standing, "joint_velocities": data.qvel[velocities]}
        observation = np.concatenate([senses[block] for block in facts["observation"]])
        ((targets,),) = policy.run(None, {"observation": observation[None]})
        senses["last_action"] = (targets - standing) / facts["action_scale"]
        data.ctrl[:] = targets
        mujoco.mj_step(model, data, nstep=round(facts["seconds_per_step"] / model.opt.timestep))
        yield observation, data


if __name__ == "__main__":
    policy_path, model_path, *velocities = sys.argv[1:]
    command = np.zeros(3)
    command[: len(velocities)] = [float(velocity) for velocity in velocities]
    *_, (_, data) = walk(policy_path, model_path, command, num_steps=500)
    x, y, height = data.qpos[:3]
    print(f"after {data.time:.1f} s: {x:.2f} m forward, {y:.2f} m to the left, the torso {height:.2f} m high")
