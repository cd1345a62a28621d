"""Every feature of a model is simulated as by the `c` engine, or refused by the name of the element."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import collision_driver
from refused_models import REFUSED
from small_models import CAPSULES, HEIGHT_FIELD, MJX, SIMULATED, load
from trajectories import visited_states

from mjx_walk.envs.physics import PhysicsState, make_engine, static_pairs
from mjx_walk.envs.physics.approximations import warn_of_approximations
from mjx_walk.envs.physics.jax_model import adapt_model
from mjx_walk.envs.physics.mjx_model import solver_iterations
from mjx_walk.envs.physics.static_pairs import drop_static_pairs
from mjx_walk.envs.state import physics_state
from mjx_walk.utils.errors import UserError


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
