"""A small model of which tests replace one part, and parts that every engine simulates."""

import mujoco

PARTS = {
    **dict.fromkeys(("option", "flag", "custom", "asset", "floor", "knee", "shin", "world"), ""),
    **dict.fromkeys(("contact", "tendon", "equality", "sensor"), ""),
    "torso": 'type="capsule" size=".05" fromto="-.15 0 0 .15 0 0"',
    "motor": '<motor name="m" joint="knee" gear="2" ctrlrange="-1 1"/>',
}
MODEL = """
<mujoco>
  <option timestep="0.004" {option}>{flag}</option>
  <custom>{custom}</custom>
  <asset>{asset}</asset>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" {floor}/>
    <body pos="0 0 .045">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <joint name="hinge" axis="0 1 0"/>
      <geom name="torso" {torso}/>
      <site name="back" pos="0 0 .1"/>
      <body name="shin" pos=".3 0 0">
        <joint name="knee" axis="0 1 0" {knee}/>
        <geom name="shin" type="capsule" size=".04" fromto="0 0 0 .3 0 .05" {shin}/>
        <site name="tip" pos=".3 0 .05"/>
      </body>
    </body>
    {world}
  </worldbody>
  <contact>{contact}</contact>
  <tendon>{tendon}</tendon>
  <equality>{equality}</equality>
  <actuator>{motor}</actuator>
  <sensor>{sensor}</sensor>
</mujoco>
"""
MOTOR = '<motor name="m" joint="knee" gear="2" ctrlrange="-1 1" {}/>'
GENERAL = '<general name="m" joint="knee" ctrlrange="-1 1" {}/>'
FIXED = '<fixed name="t" {}><joint joint="hinge" coef="1"/><joint joint="knee" coef="-.7"/></fixed>'
SPATIAL = '<spatial name="t" {}><site site="back"/><site site="tip"/></spatial>'
SPHERE = 'type="sphere" size=".05"'
WHEEL = '<body name="wheel" pos="2 0 .1"><joint axis="0 1 0"/><geom size=".12" pos="{} 0 0"/></body>'
CAPSULES = """
<mujoco>
  <worldbody>
    <geom type="capsule" size=".05" fromto="0 -.1 0 0 .1 0" {}/>
    <body pos="0 0 .1"><joint axis="0 1 0"/><geom type="capsule" size=".05" fromto=".1 -.1 0 {}"/></body>
  </worldbody>
</mujoco>
"""
TETRAHEDRON = '<mesh name="tetrahedron" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/>'
HEIGHT_FIELD = """
<mujoco>
  <asset><hfield name="h" nrow="2" ncol="2" size="1 1 .1 .1" elevation="0 1 0 .5"/></asset>
  <worldbody>
    <geom type="hfield" hfield="h"/>
    <body pos="0 0 .3"><freejoint/><geom type="{}" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""
ALL, MJX, JAX, WARP = ("c", "jax", "warp"), ("jax", "warp"), ("jax",), ("warp",)
SIMULATED = {
    "plain": {},
    "rk4": {"option": 'integrator="RK4"'},
    "elliptic": {"option": 'cone="elliptic" impratio="10"'},
    "cg": {"option": 'solver="CG" iterations="50"'},
    "pgs": {"option": 'solver="PGS" iterations="200"'},
    "condim1": {"torso": f'{SPHERE} condim="1"'},
    "condim6": {"torso": f'{SPHERE} condim="6"'},
    "margin": {"torso": f'{SPHERE} margin=".05" gap=".02"'},
    "pair": {"torso": SPHERE, "contact": '<pair geom1="floor" geom2="torso" friction=".1 .1 .1 .1 .1" condim="6"/>'},
    "max_contact_points": {"custom": '<numeric name="max_contact_points" data="1"/>'},
    "elliptic_without_friction": {
        "option": 'cone="elliptic"',
        "floor": 'friction="0"',
        "torso": f'{SPHERE} friction="0"',
        "shin": 'friction="0"',
    },
    "condim1_without_friction": {"floor": 'friction="0" condim="1" priority="1"'},
    "frictionloss": {"knee": 'frictionloss=".3"'},
    "springdamper": {"knee": 'springdamper=".1 1"'},
    "actuatorfrcrange": {"knee": 'actuatorfrcrange="-.5 .5"'},
    "forcerange": {"motor": MOTOR.format('forcerange="-.3 .3"')},
    "position": {"motor": '<position joint="knee" kp="5" kv="1" ctrlrange="-1 1"/>'},
    "velocity": {"motor": '<velocity joint="knee" kv="1" ctrlrange="-1 1"/>'},
    "site_motor": {"motor": '<motor site="tip" refsite="back" gear="0 0 1 0 0 0" ctrlrange="-1 1"/>'},
    "tendon_motor": {
        "tendon": FIXED.format('actuatorfrcrange="-.2 .2"'),
        "motor": '<motor tendon="t" ctrlrange="-1 1"/>',
    },
    "tendon_spring": {"tendon": SPATIAL.format('stiffness="10" springlength=".1 .2" damping="1" armature=".5"')},
    "tendon_limit": {"tendon": SPATIAL.format('range="0 .3" limited="true" frictionloss=".1"')},
    "tendon_equality": {"tendon": FIXED.format(""), "equality": '<tendon tendon1="t"/>'},
    "joint_equality": {"equality": '<joint joint1="hinge" joint2="knee" polycoef="0 .5 1 .5 0"/>'},
    "inactive_weld": {"equality": '<weld body1="shin" active="false"/>'},
    "mocap": {
        "world": '<body mocap="true" pos=".3 0 .1"><geom type="sphere" size=".08"/></body>'
        '<body mocap="true" pos="3 0 .05"><geom name="far" size=".08"/></body><geom name="x" size=".1" pos="4 0 0"/>',
        "contact": '<pair geom1="x" geom2="far" margin="2"/><pair geom1="x" geom2="floor"/>',
    },
    "wheel": {"world": WHEEL.format(0.03)},
    "wind": {"option": 'density="5" viscosity=".5" wind="3 0 0"'},
    "no_filterparent": {"flag": '<flag filterparent="disable"/>'},
    "no_clampctrl_no_damper": {
        "flag": '<flag clampctrl="disable" damper="disable"/>',
        "knee": 'damping="1" stiffness="5"',
    },
    "no_eulerdamp": {"flag": '<flag eulerdamp="disable"/>', "knee": 'damping="1"'},
    "no_refsafe": {"flag": '<flag refsafe="disable"/>', "torso": f'{SPHERE} solref=".004 1"'},
    "no_warmstart_no_spring": {
        "flag": '<flag warmstart="disable" spring="disable"/>',
        "knee": 'damping="1" stiffness="20"',
    },
}
"""Parts of models that every engine simulates."""


def load(parts):
    return mujoco.MjModel.from_xml_string(MODEL.format(**PARTS | parts))
