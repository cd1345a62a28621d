"""Parts of models that engines refuse, with the element that the message names."""

from small_models import ALL, FIXED, GENERAL, JAX, MJX, MOTOR, SPATIAL, SPHERE, TETRAHEDRON, WARP, WHEEL

REFUSED = {
    "user_dynamics": (
        ALL,
        {"motor": GENERAL.format('dyntype="user" actdim="1"')},
        "user dynamics of an activation (motor 'm')",
    ),
    "actearly": (
        JAX,
        {"motor": GENERAL.format('dyntype="filter" dynprm=".05" actearly="true"')},
        "actearly (motor 'm')",
    ),
    "dcmotor": (
        JAX,
        {"motor": '<dcmotor name="m" joint="knee" motorconst=".05" resistance="1" ctrlrange="-1 1"/>'},
        "direct-current motors and orientation servos (motor 'm')",
    ),
    "pid": (
        MJX,
        {"motor": '<pid name="m" joint="knee" kp="5" ki="1" ctrlrange="-1 1"/>'},
        "PID controllers (motor 'm')",
    ),
    "filterexact_rk4": (
        WARP,
        {"option": 'integrator="RK4"', "motor": GENERAL.format('dyntype="filterexact" dynprm=".05"')},
        "filterexact and inductance with RK4 (motor 'm'); set integrator=",
    ),
    **{
        f"implicitfast_no_{name}": (
            WARP,
            {"option": 'integrator="implicitfast"', "flag": f'<flag {name}="disable"/>'},
            f'implicitfast with this flag (<flag {name}="disable"/>); remove the flag',
        )
        for name in ("damper", "actuation")
    },
    "implicitfast_in_water": (
        JAX,
        {"option": 'integrator="implicitfast" density="1000"'},
        "implicitfast in a medium (density); set density and viscosity to 0",
    ),
    "delay": (ALL, {"motor": MOTOR.format('delay=".01" nsample="4"')}, "actuators with a delay (motor 'm')"),
    "sensor_delay": (
        ALL,
        {"sensor": '<jointpos name="s" joint="knee" delay=".01" nsample="4"/>'},
        "sensors with a history (sensor 's')",
    ),
    "sleep": (ALL, {"flag": '<flag sleep="enable"/>'}, 'sleeping bodies (<flag sleep="enable"/>)'),
    "discrete": (
        ALL,
        {"option": 'integrator="discrete"'},
        'this integrator (integrator="discrete"); set integrator to',
    ),
    "implicit": (
        MJX,
        {"option": 'integrator="implicit"'},
        'this integrator (integrator="implicit"); set integrator to implicitfast, Euler or RK4',
    ),
    "group": (
        MJX,
        {"option": 'actuatorgroupdisable="2"', "motor": MOTOR.format('group="2"')},
        "disabled actuator groups (motor 'm')",
    ),
    "armature": (MJX, {"motor": MOTOR.format('armature=".2"')}, "actuator armature (motor 'm')"),
    "connect": (MJX, {"equality": '<connect name="e" body1="shin" anchor=".3 0 0"/>'}, "(equality constraint 'e')"),
    "weld": (MJX, {"equality": '<weld body1="shin"/>'}, "weld constraints as MuJoCo does (equality constraint 0)"),
    "override": (MJX, {"option": 'o_margin=".02"', "flag": '<flag override="enable"/>'}, "does not support this model"),
    "diagexact": (MJX, {"flag": '<flag diagexact="enable"/>'}, "does not support this model"),
    "autoreset": (WARP, {"flag": '<flag autoreset="disable"/>'}, "does not support this model"),
    "limit_margin": (
        MJX,
        {"knee": 'range="-5 6" margin=".2"'},
        "both limits of a joint at the same time (joint 'knee'); set a margin below half the range",
    ),
    "tendon_limit_margin": (
        MJX,
        {"tendon": FIXED.format('range="-.05 .05" margin=".2"')},
        "both limits of a tendon at the same time (tendon 't')",
    ),
    "wheel": (
        MJX,
        {"world": WHEEL.format(0)},
        "contacts of a body whose joints only turn it about its center of mass (body 'wheel')",
    ),
    "mixed_contact": (MJX, {"shin": 'solref="-1000 1"'}, "a solref of one positive number"),
    "mixed_contact_without_damping": (MJX, {"torso": f'{SPHERE} solref=".02 0"'}, "takes its default (geom 'torso')"),
    "mixed_pair": (
        MJX,
        {"contact": '<pair name="p" geom1="floor" geom2="torso" solreffriction="-100 1"/>'},
        "takes its default (contact pair 'p')",
    ),
    "mixed_limit": (MJX, {"knee": 'range="-30 30" solreflimit=".02 -5"'}, "takes its default (joint 'knee')"),
    "mixed_friction": (MJX, {"knee": 'frictionloss="1" solreffriction="-100 1"'}, "takes its default (joint 'knee')"),
    "mixed_tendon_limit": (
        MJX,
        {"tendon": FIXED.format('range="-.1 .1" solreflimit="-500 1"')},
        "takes its default (tendon 't')",
    ),
    "mixed_equality": (
        MJX,
        {"equality": '<joint name="e" joint1="knee" joint2="hinge" solref=".02 -1"/>'},
        "takes its default (equality constraint 'e')",
    ),
    "user_gain": (MJX, {"motor": GENERAL.format('gaintype="user"')}, "user gains and biases (motor 'm')"),
    "user_bias": (MJX, {"motor": GENERAL.format('biastype="user"')}, "user gains and biases (motor 'm')"),
    "negative_damping": (MJX, {"knee": 'damping="-.5"'}, "negative damping and friction (joint 'knee')"),
    "negative_friction": (MJX, {"knee": 'frictionloss="-.1"'}, "negative damping and friction (joint 'knee')"),
    "negative_tendon_damping": (MJX, {"tendon": FIXED.format('damping="-.5"')}, "and friction (tendon 't')"),
    "limited_twice": (
        WARP,
        {
            "tendon": FIXED.format('actuatorfrcrange="-1 1"'),
            "motor": '<motor name="m" tendon="t" forcerange="-.5 .5"/><motor tendon="t"/>',
        },
        "limits of single motors on a tendon that limits their sum (motor 'm')",
    ),
    "almost_balanced_wheel": (JAX, {"world": WHEEL.format(0.02)}, "almost about its center of mass (body 'wheel')"),
    "no_width": (JAX, {"shin": 'solimp=".3 .9 0"'}, "a solimp of width zero as MuJoCo does (geom 'shin')"),
    "no_width_of_a_limit": (
        JAX,
        {"knee": 'range="-30 30" solimplimit=".3 .9 0"'},
        "a solimp of width zero as MuJoCo does (joint 'knee')",
    ),
    "side_site": (
        JAX,
        {
            "world": '<geom name="reel" type="cylinder" size=".05 .1" pos="0 0 2"/>',
            "tendon": SPATIAL.format("").replace("/><", '/><geom geom="reel" sidesite="tip"/><', 1),
        },
        "a sidesite on another body than its geom (tendon 't')",
    ),
    "static_tendon": (
        MJX,
        {
            "world": '<site name="one"/><site name="two" pos="1 0 0"/>',
            "tendon": '<spatial name="s" range="0 .1"><site site="one"/><site site="two"/></spatial>',
        },
        "that no joint moves in the model's own pose (tendon 's')",
    ),
    "damping": (JAX, {"motor": MOTOR.format('damping=".2"')}, "actuator damping (motor 'm')"),
    "dampingpoly": (JAX, {"knee": 'damping=".1 .2 .05"'}, "stiffness and damping (joint 'knee')"),
    "stiffnesspoly": (JAX, {"knee": 'stiffness="1 5 3"'}, "stiffness and damping (joint 'knee')"),
    "tendonpoly": (JAX, {"tendon": SPATIAL.format('damping="1 .5 .5"')}, "stiffness and damping (tendon 't')"),
    "branching_armature": (
        JAX,
        {
            "world": '<body><joint name="b"/><geom size=".1" pos=".2 0 2"/></body>',
            "tendon": '<fixed name="t" armature="1"><joint joint="b" coef="1"/><joint joint="knee" coef="1"/></fixed>',
        },
        "the armature of a tendon across branches as MuJoCo does (tendon 't')",
    ),
    "adhesion": (JAX, {"torso": f'{SPHERE} adhesion="4"'}, "adhesion (geom 'torso')"),
    "slippery": (
        MJX,
        {"floor": 'friction=".04"', "torso": f'{SPHERE} friction=".01"', "shin": 'friction=".03"'},
        "friction below 0.05 (geoms 'floor' and",
    ),
    "slippery_by_priority": (
        MJX,
        {"floor": 'friction="0" priority="1"'},
        "friction below 0.05 (geoms 'floor' and",
    ),
    "slippery_pair": (
        MJX,
        {"contact": '<pair geom1="floor" geom2="torso" friction=".02"/>'},
        "friction below 0.05 (geoms 'floor' and 'torso')",
    ),
    "pair_adhesion": (
        JAX,
        {"contact": '<pair name="sticky" geom1="floor" geom2="torso" adhesion="5"/>'},
        "adhesion (contact pair 'sticky')",
    ),
    "repeated_pair": (
        WARP,
        {
            "contact": '<pair geom1="floor" geom2="torso"/><pair geom1="shin" geom2="floor"/>'
            '<pair name="again" geom1="torso" geom2="floor" condim="1"/>'
        },
        "two contact pairs of the same geoms (contact pair 'again'); remove one of them",
    ),
    "surfacevel": (JAX, {"floor": 'surfacevel="1 0 0 0 0 0"'}, "moving surfaces (geom 'floor')"),
    "ellipsoid_fluid": (
        JAX,
        {"option": 'density="500" viscosity=".5"', "shin": 'fluidshape="ellipsoid"'},
        "the fluid forces of individual geoms (geom 'shin')",
    ),
    "noslip": (MJX, {"option": 'noslip_iterations="5"'}, "the noslip solver as MuJoCo does (noslip_iterations)"),
    "slidercrank": (
        JAX,
        {"motor": '<general cranksite="back" slidersite="tip" cranklength=".4" ctrlrange="-1 1"/>'},
        "does not support this model",
    ),
    "adhesion_motor": (JAX, {"motor": '<adhesion body="shin" ctrlrange="0 1" gain="5"/>'}, "does not support"),
    "cylinder_box": (
        JAX,
        {"torso": 'type="cylinder" size=".1 .05"', "world": '<geom type="box" size=".1 .1 .02" pos=".05 0 0"/>'},
        "contacts of these types of geoms (cylinder and box, geoms 'torso' and",
    ),
    "elliptic_condim1": (
        JAX,
        {"option": 'cone="elliptic"', "floor": 'condim="1"', "shin": 'condim="1"'},
        "elliptic contacts without friction (geoms 'floor' and 'shin'); set condim",
    ),
    "mesh_margin": (
        JAX,
        {"asset": TETRAHEDRON, "torso": 'type="mesh" mesh="tetrahedron" margin=".01"'},
        "a margin of meshes and height fields (geoms 'floor' and 'torso')",
    ),
}
"""For each feature: the engines that refuse it, the model's parts, and what the error says."""
