"""A small quadruped as an MJCF text: a box on four legs of two hinges each."""

from pathlib import Path

_LEGS = {"FL": (1, 1), "FR": (1, -1), "RL": (-1, 1), "RR": (-1, -1)}
BENT = (0.7, -1.4)
"""Angles of hip and knee in which the feet are below the hips, rad."""


def small_robot(
    angles: tuple[float, float] | None = BENT,
    actuator: str = "",
    scale: float = 1.0,
    root: str = "<freejoint/>",
    joint: str = 'armature="0.005" damping="0.1" actuatorfrcrange="-20 20"',
    before: str = "",
) -> str:
    """The text of a model.

    Args:
        angles: of hips and knees in the keyframe `home`, rad; None for a model without a keyframe.
        actuator: the tag of the motor on each hinge, `motor` or `position`, with its attributes; empty for no motors.
        scale: factor of all lengths. Masses grow with its cube.
        root: joint of the torso.
        joint: attributes of all hinges.
        before: elements of the world before the robot.
    """
    names = [f"{leg}_{part}" for leg in _LEGS for part in ("hip", "knee")]
    actuators = "".join(f'<{actuator} joint="{name}"/>' for name in names) if actuator else ""
    qpos = " ".join(map(str, [0, 0, 0.5 * scale, 1, 0, 0, 0, *4 * list(angles)])) if angles else ""
    key = f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>' if angles else ""
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004"/>
  <default><joint {joint}/><geom density="1000"/></default>
  <worldbody>
    {before}
    <body name="torso" pos="0 0 {0.4 * scale}">
      {root}
      <geom name="trunk" type="box" size="{0.15 * scale} {0.08 * scale} {0.03 * scale}"/>
      {"".join(_leg(name, *side, scale) for name, side in _LEGS.items())}
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  {key}
</mujoco>"""


def write(folder: Path, text: str) -> str:
    """Write a model, and return its path."""
    (folder / "robot.xml").write_text(text)
    return str(folder / "robot.xml")


def _leg(name: str, front: int, left: int, scale: float) -> str:
    return f"""
      <body name="{name}_thigh" pos="{0.12 * front * scale} {0.1 * left * scale} 0">
        <joint name="{name}_hip" axis="0 1 0" range="-1.5 1.5"/>
        <geom type="capsule" size="{0.015 * scale}" fromto="0 0 0 0 0 {-0.13 * scale}"/>
        <body name="{name}_shin" pos="0 0 {-0.15 * scale}">
          <joint name="{name}_knee" axis="0 1 0" range="-2.5 -0.5"/>
          <geom type="capsule" size="{0.01 * scale}" fromto="0 0 0 0 0 {-0.12 * scale}"/>
          <geom name="{name}" type="sphere" size="{0.02 * scale}" pos="0 0 {-0.15 * scale}"/>
        </body>
      </body>"""
