"""Features of MuJoCo: for each, what it adds to which slot of a model of `feature_models`."""

from feature_parts import (
    ACROSS,
    BALL,
    BETWEEN,
    BRANCHES,
    DRUM,
    FIXED,
    FREE,
    MOCAP,
    PULLEY,
    SPATIAL,
    SPHERE,
    STATIC,
    WRAP,
    flag,
)
from motor_features import MOTORS

FLAGS = {
    **{f"no_{name}": flag(name) for name in (
        *("constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper", "gravity", "clampctrl"),
        *("warmstart", "filterparent", "actuation", "refsafe", "sensor", "midphase", "eulerdamp", "autoreset"),
        *("nativeccd", "island", "multiccd"),
    )},
    **{name: flag(name, "enable") for name in (
        *("override", "energy", "fwdinv", "invdiscrete", "sleep", "diagexact"),
    )},
}  # fmt: skip
OPTIONS = {
    name: {"option": text}
    for name, text in {
        "elliptic": 'cone="elliptic"',
        "elliptic_impratio": 'cone="elliptic" impratio="10"',
        "impratio": 'impratio="10"',
        "cg": 'solver="CG" iterations="50"',
        "pgs": 'solver="PGS" iterations="200"',
        "sparse": 'jacobian="sparse"',
        "dense": 'jacobian="dense"',
        "medium": 'density="500" viscosity=".5" wind="3 1 0"',
        "density": 'density="800"',
        "viscosity": 'viscosity="3"',
        "only_wind": 'wind="5 0 0"',
        "gravity": 'gravity="2 1 -5"',
        "tolerance": 'tolerance="1e-3"',
        "ls_tolerance": 'ls_tolerance=".5"',
        "noslip": 'noslip_iterations="5"',
        "ccd_iterations": 'ccd_iterations="2"',
        "magnetic": 'magnetic="1 2 3"',
        "o_margin": 'o_margin=".02"',
        "disabled_group": 'actuatorgroupdisable="0"',
        "o_solref": 'o_solref=".1 1"',
        "implicitfast": 'integrator="implicitfast"',
        "implicit": 'integrator="implicit"',
        "discrete": 'integrator="discrete"',
    }.items()
}
JOINTS = {
    "damping": {"knee": 'damping="1"', "hinge": 'damping=".5"'},
    "dampingpoly": {"knee": 'damping=".1 .2 .05"'},
    "stiffness": {"knee": 'stiffness="5" springref="20"', "lift": 'stiffness="20"'},
    "stiffnesspoly": {"knee": 'stiffness="1 5 3"'},
    "springdamper": {"arm_joint": 'springdamper=".1 1"'},
    "armature": {"hinge": 'armature=".1"', "arm_joint": 'armature=".05"'},
    "frictionloss": {"arm_joint": 'frictionloss=".3"', "slide": 'frictionloss="1"'},
    "soft_frictionloss": {"slide": 'frictionloss="3" solreffriction=".1 1" solimpfriction=".5 .6 .1"'},
    "limit": {"arm_joint": 'range="-5 5"', "lift": 'range="-.005 .005" margin=".002"'},
    "limit_margin": {"arm_joint": 'range="-20 30" margin="25"'},
    "limit_both": {"arm_joint": 'range="-5 6" margin="20"'},
    "limit_soft": {"arm_joint": 'range="-2 2" solreflimit=".1 .5" solimplimit=".3 .6 .05 .4 3"'},
    "limit_direct": {"arm_joint": 'range="-2 2" solreflimit="-500 -5"'},
    "limit_fast": {"arm_joint": 'range="-2 2" solreflimit=".004 1"'},
    "ref": {"lift": 'ref=".5"', "arm_joint": 'ref="30" stiffness="3"'},
    "actuatorfrcrange": {"knee": 'actuatorfrcrange="-.5 .5"'},
    "actuatorgravcomp": {"knee": 'actuatorgravcomp="true"', "shin_body": 'gravcomp="1"'},
    "actuatorgravcomp_range": {"knee": 'actuatorgravcomp="true" actuatorfrcrange="-1 1"', "shin_body": 'gravcomp="1"'},
    "gravcomp": {"body": 'gravcomp=".7"', "shin_body": 'gravcomp="1.5"'},
    "ball": {"world": BALL.format('damping=".1" stiffness=".3" armature=".01" frictionloss=".01"')},
    "ball_limit": {"world": BALL.format('range="0 10" limited="true" margin="3"')},
    "free": {"world": FREE.format('stiffness="3" damping=".2" armature=".05" frictionloss=".1"')},
    "free_offset": {
        "world": '<body name="free" pos="2 0 1"><freejoint/><geom type="capsule" size=".05" fromto="0 0 0 .3 .1 0"/>'
        '<geom size=".1" pos="-.1 .2 .1"/></body>'
    },
    "free_welded": {
        "world": '<body name="free" pos="2 0 1"><joint type="free" damping=".1"/><geom type="box" size=".2 .1 .02"/>'
        '<body pos=".2 0 0" euler="10 20 30"><geom type="box" size=".02 .1 .2"/></body></body>'
    },
    "freejoint": {"world": '<body name="free" pos="2 0 .1"><freejoint/><geom type="capsule" size=".05 .1"/></body>'},
}
BODIES = {
    "inertial": {"torso_parts": '<inertial pos="0 .02 0" mass="2" diaginertia=".02 .03 .04" euler="10 20 30"/>'},
    "fullinertia": {"torso_parts": '<inertial pos="0 0 .01" mass="2" fullinertia=".02 .03 .04 .001 .002 .003"/>'},
    "balanceinertia": {"compiler": 'balanceinertia="true" boundmass=".5" boundinertia=".01"'},
    "shellinertia": {"shin": 'shellinertia="true"'},
    "mocap": {"world": MOCAP.format('pos=".3 0 .1"', "")},
    "far_mocap": {"world": MOCAP.format('pos="3 0 .05"', "")},
    "fluid_geom": {"shin": 'fluidshape="ellipsoid"', "option": 'density="500" viscosity=".5"'},
    "fluid_geom_without_medium": {"shin": 'fluidshape="ellipsoid"'},
    "fluidcoef": {"shin": 'fluidshape="ellipsoid" fluidcoef="1 .5 2 .5 1"', "option": 'density="500"'},
    "mocaps": {
        "world": '<body name="one" mocap="true" pos="3 0 .1"><geom size=".08"/>'
        '<body><geom size=".1"/></body></body>'
        '<body name="two" mocap="true" pos="3 .1 .1"><geom size=".08"/></body><geom size=".2" pos="4 0 0"/>'
    },
    "mocap_margin": {"world": MOCAP.format('pos="3 0 .2"', 'margin=".3"')},
    "mocap_plane": {
        "world": '<body mocap="true" pos="3 0 .05"><geom type="plane" size="1 1 1" euler="0 180 0"/></body>'
        '<geom size=".1" pos="3 0 0"/>'
    },
    "mocap_pair": {
        "world": MOCAP.format('pos="3 0 .05"', 'name="mocap" contype="0" conaffinity="0"'),
        "contact": '<pair geom1="floor" geom2="mocap" margin=".1"/>',
    },
    "world_pair": {
        "world": '<geom name="one" size=".1" pos="3 0 0"/><geom name="two" size=".1" pos="3 .1 0"/>',
        "contact": '<pair geom1="one" geom2="two"/><pair geom1="floor" geom2="one"/>',
    },
    "wheel": {"world": '<body name="wheel" pos="2 0 .1"><joint name="axle" axis="0 1 0"/><geom size=".12"/></body>'},
    "two_trees": {"world": '<body name="second" pos=".1 0 .2"><freejoint/><geom type="sphere" size=".06"/></body>'},
}
CONTACTS = {
    "condim1": SPHERE | {"floor": 'condim="1"', "torso": 'type="sphere" size=".05" condim="1"'},
    "condim4": {"floor": 'condim="4" friction="1 .1 .01"'},
    "condim6": {"floor": 'condim="6" friction="1 .1 .05"'},
    "margin": {"floor": 'margin=".02"', "shin": 'margin=".01"'},
    "gap": {"floor": 'margin=".03" gap=".02"'},
    "negative_gap": {"floor": 'gap=".01"'},
    "friction": {"floor": 'friction=".1"', "shin": 'friction=".05"'},
    "anisotropic_pair": {"contact": '<pair geom1="floor" geom2="torso" friction="1 .2 .1 .05 .01" condim="6"/>'},
    "pair": {
        "contact": '<pair geom1="floor" geom2="torso" solref=".05 .7" solimp=".5 .8 .02" margin=".02" gap=".01"/>'
    },
    "pair_solreffriction": {"contact": '<pair geom1="floor" geom2="torso" solreffriction=".1 .8" condim="3"/>'},
    "pair_adhesion": {"contact": '<pair geom1="floor" geom2="torso" adhesion="5"/>'},
    "pair_of_neighbors": {"contact": '<pair geom1="torso" geom2="shin" solref=".1 1"/>'},
    "pair_condim1": {"contact": '<pair geom1="floor" geom2="torso" condim="1"/>'},
    "exclude": {"contact": '<exclude body1="world" body2="shin"/><exclude body1="torso" body2="arm_body"/>'},
    "priority": {"floor": 'friction=".1" solref=".05 1" solimp=".4 .6 .01" condim="4"', "shin": 'priority="1"'},
    "solmix": {"floor": 'solmix="3" solref=".08 1"', "shin": 'solmix=".5" solimp=".3 .5 .01 .3 3"'},
    "zero_solmix": {"floor": 'solmix="0" solref=".08 1"'},
    "solref_direct": {"floor": 'solref="-3000 -30"', "shin": 'solref="-2000 -50"'},
    "solref_mixed": {"floor": 'solref="-3000 -30"', "shin": 'solref=".05 1"'},
    "solref_both_direct": {"floor": 'solref="-3000 -30"', "shin": 'solref="-5000 -10"', "torso": 'solref="-900 -90"'},
    "solref_fast": {"floor": 'solref=".004 1"', "shin": 'solref=".004 1"'},
    "solimp": {"floor": 'solimp=".2 .95 .02 .3 4"'},
    "solimp_power1": {"floor": 'solimp=".1 .9 .01 .5 1"', "torso": 'solimp=".1 .9 .01 .5 1"'},
    "solimp_one": {"floor": 'solimp="1.2 1 0 .5 .5"'},
    "contype": {"shin": 'contype="2" conaffinity="0"'},
    "no_contype": {"shin": 'contype="0" conaffinity="0"'},
    "adhesion": {"floor": 'adhesion="4"'},
    "surfacevel": {"floor": 'surfacevel="1 0 0 0 0 0"'},
    "max_contact_points": {"custom": '<numeric name="max_contact_points" data="1"/>'},
    "max_geom_pairs": {"custom": '<numeric name="max_geom_pairs" data="1"/>'},
    "zero_friction": {"floor": 'friction="0"', "torso": 'friction="0"', "shin": 'friction="0"', "arm": 'friction="0"'},
    "nconmax": {"size": 'nconmax="1"'},
    "njmax": {"size": 'njmax="6"'},
}
TENDONS = {
    f"{name}_{kind}": {"tendon": text.format(attributes), "torso_parts": DRUM}
    for name, text in {
        **{"fixed": FIXED, "branches": BRANCHES, "spatial": SPATIAL, "across": ACROSS, "wrap": WRAP},
        "pulley": PULLEY,
    }.items()
    for kind, attributes in {
        "spring": 'stiffness="10" springlength=".1 .2"',
        "damping": 'damping="2"',
        "armature": 'armature=".5"',
        "limit": 'range="0 .1" margin=".02"',
        "frictionloss": 'frictionloss=".2"',
    }.items()
} | {
    "side_site": {"torso_parts": DRUM, "tendon": '<spatial stiffness="20" springlength=".2"><site site="hand"/>'
                  '<geom geom="drum" sidesite="hand"/><site site="tip"/></spatial>'},
    **{
        f"static_{kind}": {"world": STATIC, "tendon": BETWEEN.format(text)}
        for kind, text in {
            "limit": 'range="0 .1"',
            "friction": 'frictionloss="1"',
            "spring": 'stiffness="5" armature="1"',
        }.items()
    },
    "tendon_poly": {"tendon": SPATIAL.format('damping="1 .5 .5"')},
    "tendon_stiffnesspoly": {"tendon": FIXED.format('stiffness="1 .5 .5"')},
    "tendon_limit_both": {"tendon": FIXED.format('range="-.05 .05" margin=".2"')},
    "tendon_soft": {"tendon": FIXED.format('range="-.02 .02" solreflimit=".1 1" solimplimit=".4 .6 .1"')},
    "tendon_soft_friction": {"tendon": FIXED.format('frictionloss="1" solreffriction=".1 1" solimpfriction=".4 .5"')},
}  # fmt: skip
EQUALITIES = {
    "connect": {"equality": '<connect body1="shin" anchor=".3 0 0"/>'},
    "weld": {"equality": '<weld body1="shin"/>'},
    "inactive_weld": {"equality": '<weld body1="shin" active="false"/>'},
    "joint_equality": {"equality": '<joint joint1="hinge" joint2="knee" polycoef="0 .5 1 .5 0"/>'},
    "joint_equality_alone": {"equality": '<joint joint1="arm" polycoef=".1 0 0 0 0" solref=".1 1" solimp=".5 .7 .1"/>'},
    "tendon_equality": {"tendon": FIXED.format(""), "equality": '<tendon tendon1="fixed"/>'},
    "tendons_equality": {
        "tendon": FIXED.format("") + ACROSS.format(""),
        "equality": '<tendon tendon1="fixed" tendon2="across" polycoef="0 .5 1 0 0"/>',
    },
}
SENSORS = {
    "sensor_cutoff": {"sensor": '<jointpos joint="knee" cutoff=".1"/>'},
    "sensor_delay": {"sensor": '<jointpos name="s" joint="knee" delay=".01" nsample="4"/>'},
    "touch": {"sensor": '<touch site="tip"/>'},
}
GROUPS = {
    "flag": FLAGS, "option": OPTIONS, "joint": JOINTS, "body": BODIES, "contact": CONTACTS, "tendon": TENDONS,
    "equality": EQUALITIES, "motor": MOTORS, "sensor": SENSORS,
}  # fmt: skip
FEATURES = {name: parts for group in GROUPS.values() for name, parts in group.items()}
