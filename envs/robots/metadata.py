"""A robot as facts for programs that do not use this package."""

import numpy as np

from mjx_walk.envs.robots.robot import Robot

__all__ = ["servo_metadata"]


def servo_metadata(robot: Robot) -> dict[str, object]:
    """Joints, gains and limits of the servos in the order of actions, and the standing pose.

    The names are those of mjlab's ONNX files, where it has them (`rl/exporter_utils.py`).

    Returns:
        By name: `joint_names`; `default_joint_pos`, rad; `joint_stiffness`, N·m/rad; `joint_damping`, N·m·s/rad;
        `joint_armature`, kg·m²; `joint_pos_limits`, the range of each target, rad; `joint_torque_limits`, N·m, None for
        a servo without; and `default_qpos`, the standing pose of all joints.
    """
    model, dofs = robot.model, robot.velocities
    limits = zip(model.actuator_forcelimited, model.actuator_forcerange[:, 1], strict=True)
    return {
        "joint_names": [model.joint(model.dof_jntid[dof]).name for dof in dofs],
        "default_joint_pos": robot.targets.tolist(),
        "joint_stiffness": model.actuator_gainprm[:, 0].tolist(),
        "joint_damping": (-model.actuator_biasprm[:, 2]).tolist(),
        "joint_armature": model.dof_armature[dofs].tolist(),
        "joint_pos_limits": model.actuator_ctrlrange.tolist(),
        "joint_torque_limits": [float(torque) if limited else None for limited, torque in limits],
        "default_qpos": np.float32(robot.standing).tolist(),  # as a reset takes it: contacts depend on its last digits
    }
