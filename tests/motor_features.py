"""Features of motors: for each, what it adds to which slot of a model of `feature_models`."""

from feature_parts import ACROSS, FIXED, FREE, GENERAL, HUNG, MUSCLE

MOTORS = {
    "gear": {"motor": 'forcerange="-.3 .3"'},
    "position": {"actuator": '<position joint="arm" kp="5" kv="1" ctrlrange="-1 1"/>'},
    "dampratio": {"actuator": '<position joint="arm" kp="5" dampratio="1" ctrlrange="-1 1"/>'},
    "position_timeconst": {"actuator": '<position joint="arm" kp="5" timeconst=".1" ctrlrange="-1 1"/>'},
    "velocity": {"actuator": '<velocity joint="arm" kv="1" ctrlrange="-1 1"/>'},
    "intvelocity": {"actuator": '<intvelocity joint="arm" kp="1" actrange="-1 1" ctrlrange="-1 1"/>'},
    "damper": {"actuator": '<damper joint="arm" kv="1" ctrlrange="0 1"/>'},
    "cylinder": {"actuator": '<cylinder joint="arm" ctrlrange="-1 1"/>'},
    "muscle": {"actuator": '<muscle joint="arm" ctrlrange="0 1" lengthrange="-1 1" force="10"/>'},
    "muscle_gain": {
        "actuator": f'<general joint="arm" ctrlrange="0 1" lengthrange="-1 1" gaintype="muscle" gainprm="{MUSCLE}" '
        f'biastype="muscle" biasprm="{MUSCLE}"/>'
    },
    "affine": {
        "actuator": GENERAL.format(
            'joint="arm" gaintype="affine" gainprm="1 2 -.5" biastype="affine" biasprm=".2 -1 -.3"'
        )
    },
    "orientation": {"world": HUNG, "actuator": '<orientation joint="ball" kp="2" kv=".1"/>'},
    "orientation_ranged": {"world": HUNG, "actuator": '<orientation joint="ball" kp="2" ctrlrange="-1 1"/>'},
    **{
        name: {"actuator": GENERAL.format(f'joint="arm" gainprm="3" {text}')}
        for name, text in {
            "integrator": 'dyntype="integrator"',
            "integrator_actrange": 'dyntype="integrator" actrange="-.01 .01"',
            "integrator_servo": 'dyntype="integrator" biastype="affine" biasprm="0 -3 -.2"',
            "filter": 'dyntype="filter" dynprm=".05"',
            "filterexact": 'dyntype="filterexact" dynprm=".05"',
            "filterexact_fast": 'dyntype="filterexact" dynprm=".001"',
            "filterexact_actrange": 'dyntype="filterexact" dynprm=".02" actrange="-.1 .2"',
            "muscle_dynamics": 'dyntype="muscle" dynprm=".01 .04"',
            "muscle_smooth": 'dyntype="muscle" dynprm=".01 .04 .3"',
            "actearly": 'dyntype="filterexact" dynprm=".05" actearly="true"',
            "actearly_integrator": 'dyntype="integrator" actearly="true" actrange="-.01 .01"',
            "user_dynamics": 'dyntype="user" actdim="1"',
        }.items()
    },
    "filter_affine": {
        "actuator": GENERAL.format('joint="arm" dyntype="filter" dynprm=".05" gaintype="affine" gainprm="1 2 -.5"')
    },
    "two_filters": {
        "motor": 'group="1"',
        "actuator": GENERAL.format('joint="arm" gainprm="3" dyntype="filter" dynprm=".05"')
        + '<motor joint="hinge" ctrlrange="-1 1"/>'
        + GENERAL.format('joint="knee" gainprm="2" dyntype="integrator"'),
    },
    "servo_forcerange": {"actuator": '<position joint="arm" kp="50" kv="2" forcerange="-1 1" ctrlrange="-1 1"/>'},
    "servo_inheritrange": {
        "arm_joint": 'range="-40 40"',
        "actuator": '<position joint="arm" kp="5" dampratio=".7" inheritrange="1"/>',
    },
    "servo_frcrange": {
        "arm_joint": 'actuatorfrcrange="-.5 .5"',
        "actuator": '<position joint="arm" kp="50" kv="2" ctrlrange="-1 1"/>',
    },
    "tendon_servo": {
        "tendon": ACROSS.format(""),
        "actuator": '<position tendon="across" kp="5" kv="3" ctrlrange="0 1"/>',
    },
    "tendon_servo_range": {
        "tendon": FIXED.format('actuatorfrcrange="-.2 .2"'),
        "actuator": '<position tendon="fixed" kp="9" kv="3" ctrlrange="-1 1"/>',
    },
    "pid": {"actuator": '<pid joint="arm" kp="5" ki="1" kv="1" ctrlrange="-1 1"/>'},
    "pid_without_i": {"actuator": '<pid joint="arm" kp="5" kv="1" ctrlrange="-1 1"/>'},
    "dcmotor": {"actuator": '<dcmotor joint="arm" motorconst=".05" resistance="1" ctrlrange="-1 1"/>'},
    "dcmotor_inductance": {
        "actuator": '<dcmotor joint="arm" motorconst=".5" resistance="1" inductance=".01" ctrlrange="-1 1"/>'
    },
    "motor_armature": {"motor": 'armature=".2"'},
    "motor_damping": {"motor": 'damping=".2"'},
    "motor_dampingpoly": {"motor": 'damping=".2 .1 .1"'},
    "motor_delay": {"motor": 'delay=".01" nsample="4"'},
    "tendon_motor": {"tendon": FIXED.format(""), "actuator": '<motor tendon="fixed" ctrlrange="-1 1"/>'},
    "tendon_motor_range": {
        "tendon": FIXED.format('actuatorfrcrange="-.2 .2"') + ACROSS.format('actuatorfrcrange="-1 1"'),
        "actuator": '<motor tendon="fixed" ctrlrange="-1 1"/><motor tendon="across" gear="3" ctrlrange="-1 1"/>',
    },
    "two_tendon_motors": {
        "tendon": FIXED.format('actuatorfrcrange="-.2 .2"'),
        "actuator": '<motor tendon="fixed" ctrlrange="-1 1"/><position kp="3" tendon="fixed" ctrlrange="-1 1"/>',
    },
    "site_motor": {"actuator": '<motor site="tip" gear="0 1 1 .2 .1 0" ctrlrange="-1 1"/>'},
    "refsite_motor": {"actuator": '<motor site="tip" refsite="back" gear="0 0 1 0 0 0" ctrlrange="-1 1"/>'},
    "refsite_branches": {"actuator": '<motor site="tip" refsite="hand" gear="1 0 1 0 1 0" ctrlrange="-1 1"/>'},
    "refsite_servo": {"actuator": '<position site="tip" refsite="back" kp="2" gear="0 0 0 0 1 0" ctrlrange="-4 4"/>'},
    "jointinparent": {"actuator": '<motor jointinparent="arm" ctrlrange="-1 1"/>'},
    "ball_motor": {"world": HUNG, "actuator": '<motor joint="ball" gear="1 .5 .2" ctrlrange="-1 1"/>'},
    "ball_servo": {"world": HUNG, "actuator": '<position joint="ball" kp="1" gear="1 .5 0" ctrlrange="-4 4"/>'},
    "ball_in_parent": {"world": HUNG, "actuator": '<motor jointinparent="ball" gear="1 .5 .2" ctrlrange="-1 1"/>'},
    "free_motor": {
        "world": FREE.format(""),
        "actuator": '<motor joint="free" gear="1 0 5 .1 .1 0" ctrlrange="-1 1"/>',
    },
    "free_in_parent": {
        "world": FREE.format(""),
        "actuator": '<motor jointinparent="free" gear="1 0 5 .1 .1 0" ctrlrange="-1 1"/>',
    },
    "slidercrank": {"actuator": '<general cranksite="back" slidersite="tip" cranklength=".4" ctrlrange="-1 1"/>'},
    "body_adhesion": {"actuator": '<adhesion body="torso" ctrlrange="0 1" gain="5"/>'},
}
