"""A MuJoCo model that has a little of everything, for sweeps over arrays and sensors."""

import mujoco

RICH = """
<mujoco>
  <option timestep="0.004" iterations="100" {option}><flag {flag}/></option>
  <size nuserdata="3"/>
  <worldbody>
    <light pos="0 0 3" mode="targetbody" target="torso"/>
    <camera name="fixed" pos="0 -3 1"/>
    <camera pos="0 -3 1" mode="trackcom"/>
    <geom type="plane" size="5 5 .1"/>
    <body name="torso" pos="0 0 {height}">
      <freejoint/>
      <camera name="eye" pos="0 0 .1" mode="targetbody" target="tool"/>
      <light pos="0 0 .3" mode="trackcom"/>
      <geom type="capsule" size=".05" fromto="-.15 0 0 .15 0 0"/>
      <geom name="pulley" type="sphere" size=".02" pos=".25 0 .1" contype="0" conaffinity="0"/>
      <site name="back" pos="0 0 .1"/>
      <body name="shin" pos=".3 0 0" gravcomp=".5">
        <joint name="knee" axis="0 1 0" stiffness="2" damping=".3" armature=".02" frictionloss=".1" range="-40 40"/>
        <geom name="shin" type="capsule" size=".04" fromto="0 0 0 .3 0 .05"/>
        <site name="tip" pos=".3 0 .05"/>
        <body pos=".35 0 .05">
          <joint name="ball" type="ball" damping=".1"/>
          <geom type="sphere" size=".06"/>
          <site name="end" pos=".1 .02 0" size=".03"/>
        </body>
      </body>
      <body name="arm" pos="-.3 0 0">
        <joint name="arm" axis="1 0 1" damping=".2"/>
        <joint type="slide" axis="1 0 0" damping=".5" stiffness="20"/>
        <geom name="arm" type="capsule" size=".04" fromto="0 0 0 -.3 0 .05"/>
        <site name="hand" pos="-.3 0 .05"/>
      </body>
    </body>
    <body name="tool" mocap="true" pos=".6 .5 .5"><geom type="sphere" size=".05" contype="0" conaffinity="0"/></body>
    <body pos="2 2 1"><geom type="sphere" size=".1"/><body pos="0 0 .2"><geom type="sphere" size=".1"/></body></body>
    <body pos="-2 0 1"><joint axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 .2 0 -.3"/></body>
  </worldbody>
  {tendon}
  <equality>
    <joint joint1="arm" joint2="knee" polycoef="0 .5 1 .5 0"/>
    <weld body1="arm" active="false"/>
  </equality>
  <actuator>
    <motor name="m" joint="knee" gear="2" ctrlrange="-1 1"/>
    <position name="p" joint="arm" kp="5" kv="1" ctrlrange="-1 1"/>
    {motor}
  </actuator>
  <sensor>{sensor}</sensor>
</mujoco>
"""
"""All kinds of joints, contacts, limits, friction, equality, mocap and static bodies, cameras and lights."""
FIXED = """<fixed name="t" stiffness="1" damping=".2" range="-.1 .1" limited="true">
  <joint joint="arm" coef="1"/><joint joint="knee" coef="-.7"/></fixed>"""
SPATIAL = """<spatial name="s" stiffness="10" damping="1" springlength=".1 .2">
  <site site="back"/><geom geom="pulley"/><site site="tip"/></spatial>
<spatial range="0 .5" limited="true" frictionloss=".1" armature=".3"><site site="hand"/><site site="back"/></spatial>"""
ACTIVATION = """<general joint="arm" dyntype="filterexact" dynprm=".05" gainprm="2" ctrlrange="-1 1"/>
<general joint="knee" dyntype="integrator" gainprm="3" actrange="-.1 .1" ctrlrange="-1 1"/>
<muscle joint="arm" lengthrange="-1 1" force="5" ctrlrange="0 1"/>"""
"""Actuators with an activation."""
FORCE_SENSORS = '<accelerometer site="tip"/><force site="tip"/><torque site="hand"/><touch site="end"/>'
SENSORS = {
    **{kind: f'<{kind} site="tip"/>' for kind in ("accelerometer", "velocimeter", "gyro", "force", "magnetometer")},
    **{kind: f'<{kind} joint="knee"/>' for kind in ("jointpos", "jointvel", "jointactuatorfrc")},
    **{kind: f'<{kind} joint="knee"/>' for kind in ("jointlimitpos", "jointlimitvel", "jointlimitfrc")},
    **{kind: f'<{kind} tendon="t"/>' for kind in ("tendonpos", "tendonvel", "tendonactuatorfrc")},
    **{kind: f'<{kind} tendon="t"/>' for kind in ("tendonlimitpos", "tendonlimitvel", "tendonlimitfrc")},
    **{kind: f'<{kind} actuator="p"/>' for kind in ("actuatorpos", "actuatorvel", "actuatorfrc")},
    **{kind: f'<{kind} joint="ball"/>' for kind in ("ballquat", "ballangvel")},
    **{
        kind: f'<{kind} objtype="site" objname="tip" reftype="body" refname="arm"/>'
        for kind in ("framepos", "framequat")
    },
    **{kind: f'<{kind} objtype="geom" objname="arm"/>' for kind in ("framexaxis", "frameyaxis", "framezaxis")},
    **{
        kind: f'<{kind} objtype="site" objname="tip" reftype="body" refname="arm"/>'
        for kind in ("framelinvel", "frameangvel")
    },
    **{kind: f'<{kind} objtype="body" objname="shin"/>' for kind in ("framelinacc", "frameangacc")},
    **{kind: f'<{kind} body="shin"/>' for kind in ("subtreecom", "subtreelinvel", "subtreeangmom")},
    **{kind: f'<{kind} geom1="shin" geom2="arm" cutoff="2"/>' for kind in ("distance", "normal", "fromto")},
    **{kind: f"<{kind}/>" for kind in ("e_potential", "e_kinetic", "clock")},
    "torque": '<torque site="hand"/>',
    "touch": '<touch site="end"/>',
    "rangefinder": '<rangefinder site="back"/>',
    "camprojection": '<camprojection site="tip" camera="fixed"/>',
    "insidesite": '<insidesite site="end" objtype="site" objname="tip"/>',
    "contact": '<contact geom1="arm" num="2" data="found force dist pos normal"/>',
    "user": '<user dim="2" needstage="acc"/>',
    "cutoff": '<jointvel joint="knee" cutoff=".1"/>',
}
"""One sensor of each kind."""
NOT_ON_MJX = {
    *("jointlimitpos", "jointlimitvel", "jointlimitfrc", "tendonlimitpos", "tendonlimitvel", "tendonlimitfrc"),
    *(
        "distance",
        "normal",
        "fromto",
        "e_potential",
        "e_kinetic",
        "insidesite",
        "user",
        "clock",
        "rangefinder",
        "contact",
    ),
}
"""Kinds that one of the MJX engines does not compute as MuJoCo does."""
SUBTREE_SENSORS = '<subtreelinvel body="torso"/><subtreeangmom body="shin"/><subtreecom body="torso"/>'


def rich(
    integrator: str = "Euler", height: float = 0.05, option: str = "", text: str = RICH, **parts: str
) -> mujoco.MjModel:
    """The model `RICH` with other parts."""
    parts = {"tendon": "", "motor": "", "sensor": "", "flag": 'contact="enable"'} | parts
    if parts["tendon"]:
        parts["tendon"] = f"<tendon>{parts['tendon']}</tendon>"
    option = f'integrator="{integrator}" {option}'
    return mujoco.MjModel.from_xml_string(text.format(option=option, height=height, **parts))


def sensors(*kinds: str) -> mujoco.MjModel:
    """A model with these sensors, at the limits of a joint and a tendon."""
    tendon, parts = FIXED.replace("-.1 .1", "-.001 .001"), "".join(SENSORS[kind] for kind in kinds)
    text = RICH.replace("-40 40", "-.5 .5").replace('size=".03"', 'size=".2"')
    return rich(text=text, tendon=tendon, sensor=parts, motor='<motor tendon="t" ctrlrange="-1 1"/>')
