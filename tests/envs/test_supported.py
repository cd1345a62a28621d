"""Every feature of a model is simulated as by the `c` engine, or refused by the name of the element."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import collision_driver
from trajectories import visited_states

from mjx_walk.envs.physics import PhysicsState, make_engine, static_pairs
from mjx_walk.envs.physics.approximations import warn_of_approximations
from mjx_walk.envs.physics.jax_model import adapt_model
from mjx_walk.envs.physics.mjx_model import solver_iterations
from mjx_walk.envs.physics.static_pairs import drop_static_pairs
from mjx_walk.envs.state import physics_state
from mjx_walk.utils.errors import UserError

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


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(name):
    engines, parts, says = REFUSED[name]
    for engine in engines:
        with pytest.raises(UserError) as refused:
            make_engine(engine, load(parts), 1, ())
        assert says in str(refused.value) and "\n" not in str(refused.value)
    if "c" not in engines:
        make_engine("c", load(parts), 1, ())


@pytest.mark.parametrize(
    ("end", "contact", "is_warned_of"),
    [(".1 .1 0", "", True), (".1 .1 .01", "", False), (".1 .1 0", 'contype="0" conaffinity="0"', False)],
)
def test_capsules_that_stay_parallel_are_warned_of(end, contact, is_warned_of, caplog):
    """MuJoCo has two contacts between them, the `jax` engine one."""
    warn_of_approximations(mujoco.MjModel.from_xml_string(CAPSULES.format(contact, end)), "jax", 0)
    assert ("between capsule '0' and capsule '1'; physics=warp" in caplog.text) == is_warned_of


@pytest.mark.parametrize(
    ("kind", "warned"), [("sphere", ()), ("capsule", ("jax",)), ("box", ("jax", "warp")), ("cylinder", ("warp",))]
)
def test_contacts_on_a_height_field_are_as_in_mujoco_or_warned_of(kind, warned, caplog):
    model = mujoco.MjModel.from_xml_string(HEIGHT_FIELD.format(kind))
    for engine in ("jax", "warp") if kind != "cylinder" else ("warp",):  # jax refuses cylinders
        caplog.clear()
        warn_of_approximations(model, engine, 0)
        says = f"physics={engine} finds other contact points than MuJoCo between hfield '0' and {kind} '1'"
        assert (says in caplog.text) == (engine in warned)


@pytest.mark.parametrize(
    ("kinds", "is_warned_of"),
    [
        (("cylinder", "box"), True),
        (("capsule", "ellipsoid"), True),
        (("capsule", "box"), False),
        (("box", "box"), False),
    ],
)
def test_contacts_of_round_geoms_on_warp_are_warned_of(kinds, is_warned_of, caplog):
    fixed, falling = (f'<geom type="{kind}" size=".1 .1 .1"/>' for kind in kinds)
    text = f"<mujoco><worldbody>{fixed}<body><freejoint/>{falling}</body></worldbody></mujoco>"
    warn_of_approximations(mujoco.MjModel.from_xml_string(text), "warp", 0)
    assert (
        f"other contact points than MuJoCo between {kinds[0]} '0' and {kinds[1]} '1'" in caplog.text
    ) == is_warned_of


def test_the_solver_has_more_iterations_for_elliptic_cones_and_many_pairs_of_geoms():
    """Robots need them; Humanoid with 126 pairs and smaller models do not."""
    body = '<body pos="{0} 0 0"><freejoint/><geom size=".1"/></body>'
    for cone, num_bodies, expected in (("pyramidal", 16, 8), ("pyramidal", 17, 16), ("elliptic", 2, 16)):
        bodies = "".join(body.format(i) for i in range(num_bodies))
        text = f'<mujoco><option cone="{cone}"/><worldbody>{bodies}</worldbody></mujoco>'
        assert solver_iterations(mujoco.MjModel.from_xml_string(text)) == expected


@pytest.mark.parametrize(("engine", "is_warned_of"), [("jax", True), ("warp", False)])
def test_detailed_meshes_compile_slowly_on_jax(engine, is_warned_of, caplog):
    points = np.random.default_rng(0).normal(size=(100, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    body = '<body pos="{0} 0 0"><freejoint/><geom type="mesh" mesh="stone"/></body>'
    for attribute, says in (("", is_warned_of), ('maxhullvert="32"', False)):
        mesh = f'<mesh name="stone" vertex="{" ".join(map(str, points.ravel()))}" {attribute}/>'
        text = f"<mujoco><asset>{mesh}</asset><worldbody>{body.format(0)}{body.format(3)}</worldbody></mujoco>"
        caplog.clear()
        warn_of_approximations(mujoco.MjModel.from_xml_string(text), engine, 0)
        assert ("slowly for mesh 'stone' with 100 vertices; set its maxhullvert=\"32\"" in caplog.text) == says


def test_contacts_between_bodies_that_cannot_move_are_dropped():
    model = load(SIMULATED["mocap"])
    drop_static_pairs(model)
    assert (model.pair_margin == -1e10).all()
    static_pairs.install()
    bodies = [model.geom_bodyid[list(pair[:2])] for pair in collision_driver.geom_pairs(model)]
    assert bodies and all(model.body_dofnum[pair].any() for pair in bodies)


def test_pairs_of_geoms_are_found_once_per_model(monkeypatch):
    """In checks, in MJX and in both programs; with hundreds of bodies, each search takes a second."""
    searched = []

    def search(model):
        searched.append(type(model))
        return upstream(model)

    upstream = static_pairs._UPSTREAM
    monkeypatch.setattr(static_pairs, "_UPSTREAM", search)
    monkeypatch.setattr(static_pairs, "_known", {})
    for parts, num_pairs in (({}, 2), ({"shin": 'contype="0" conaffinity="0"'}, 1)):
        searched.clear()
        model = load(parts)
        engine = make_engine("jax", model, 1, ())
        state = PhysicsState(*(jnp.zeros(size) for size in (model.nq, model.nv, model.nv)))
        jax.eval_shape(engine.forward, state)
        jax.eval_shape(engine.step, state, jnp.zeros(model.nu))
        assert searched == [mujoco.MjModel]
        assert len([*collision_driver.geom_pairs(model)]) == num_pairs


def test_the_pairs_depend_on_nothing_but_the_arrays_that_identify_a_model():
    """A later MJX might read more."""
    read = set()

    class Reader:
        def __getattr__(self, name):
            read.add(name)
            return getattr(model, name)

    model = load({"shin": 'contype="3"'})
    assert [*static_pairs._UPSTREAM(Reader())]
    assert read - {"npair", "nbody", "opt"} <= {*static_pairs._READ_BY_UPSTREAM}


@pytest.mark.parametrize(
    ("flags", "kept"), [((), (True, True)), (("spring",), (False, True)), (("damper",), (True, False))]
)
def test_spring_and_damper_flags_on_the_jax_engine(flags, kept):
    disabled = " ".join(f'{flag}="disable"' for flag in flags)
    model = load({"flag": f"<flag {disabled}/>", "knee": 'stiffness="5" damping="1"'})
    adapt_model(model)
    assert (model.jnt_stiffness.any(), model.dof_damping.any()) == kept and not model.opt.disableflags


@pytest.mark.slow
@pytest.mark.parametrize("engine", MJX)
@pytest.mark.parametrize("name", SIMULATED)
def test_simulated_as_by_the_c_engine(name, engine):
    model = load(SIMULATED[name])
    states, controls = visited_states(model, num_envs=8, num_steps=10)
    expected, found = (
        np.asarray(jax.jit(jax.vmap(make_engine(one, model, 1, ()).step))(states, controls)[0].qvel)
        for one in ("c", engine)
    )
    change = np.abs(expected - states.qvel).max(axis=1)
    errors = np.abs(found - expected).max(axis=1) / (1 + change)
    assert np.median(change) > 1e-2
    assert np.quantile(errors, 0.9) < 5e-4


def test_boxes_touch_on_warp_as_in_mujoco():
    """A box dips into another one in random orientations. Warp's own contacts give errors of up to 2.9."""
    geoms = '<geom type="box" size="1 1 .1"/><body><freejoint/><geom type="box" size=".1 .08 .05"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    rng = np.random.default_rng(0)
    qpos = np.concatenate([rng.uniform([-0.3, -0.3, 0.1], [0.3, 0.3, 0.18], (128, 3)), rng.normal(size=(128, 4))], 1)
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    qvel = rng.normal(size=(128, 6))
    states = jax.vmap(lambda *x: physics_state(model, *x))(qpos, qvel)
    expected, found = (
        np.asarray(jax.jit(jax.vmap(make_engine(one, model, 1, ()).step))(states, jnp.zeros((128, 0)))[0].qvel)
        for one in ("c", "warp")
    )
    change = np.abs(expected - qvel).max(axis=1)
    assert (change > 1).sum() > 50
    assert (np.abs(found - expected).max(axis=1) / (1 + change)).max() < 1e-4


def test_environments_of_the_c_engine_do_not_share_a_state():
    """A resting environment stays the same, whatever its neighbor does."""
    model = load({**SIMULATED["mocap"], "equality": '<weld body1="shin" active="true"/>'})
    step = jax.jit(jax.vmap(make_engine("c", model, 1, ()).step))
    state = PhysicsState(*(jnp.tile(jnp.float32(x), (2, 1)) for x in (model.qpos0, np.zeros(4), np.zeros(4))))
    alone, acting = state, state
    for _ in range(5):
        alone, acting = step(alone, jnp.zeros((2, 1)))[0], step(acting, jnp.float32([[0.0], [1.0]]))[0]
    np.testing.assert_array_equal(alone.qvel[0], acting.qvel[0])
    assert (acting.qvel[0] != acting.qvel[1]).any()
