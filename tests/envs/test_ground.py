"""Hills: their heights are those of MuJoCo's geoms, and a body is observed and rewarded by its height above them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robot
from helpers import slow_except

from mjx_walk.envs import make_env
from mjx_walk.envs.ground.options import PRESETS, Ground
from mjx_walk.envs.ground.profile import FOOT, ROW_LENGTH, sections
from mjx_walk.envs.model_files import model_path
from mjx_walk.envs.models import load_spec
from mjx_walk.envs.walker2d import Walker2d, Walker2dOptions
from mjx_walk.settings.config import load_config
from mjx_walk.utils.errors import UserError
from mjx_walk.viewing.episode import make_gymnasium

TOP = FOOT + (ROW_LENGTH - FOOT) / 2
"""x of the top of the first hill, m."""


def highest(model, x, y):
    """Height of the highest geom of the world at a place, m. No body is in the way."""
    data = mujoco.MjData(model)
    data.geom_xpos[:], data.geom_xmat[:] = model.geom_pos, 0.0
    for geom in range(model.ngeom):
        mujoco.mju_quat2Mat(data.geom_xmat[geom], model.geom_quat[geom])
    data.geom_xpos[model.geom_bodyid > 0] = -9.0
    return 9.0 - mujoco.mj_ray(model, data, np.array([x, y, 9.0]), -np.eye(3)[2], None, 1, -1, np.zeros(1, np.int32))


@pytest.mark.parametrize("kind", PRESETS)
def test_heights_are_those_of_the_geoms(kind):
    task = make_env("walker2d", "c", ground=kind)
    places = np.random.default_rng(0).uniform([-2.0, -17.0], [39.0, 17.0], (300, 2))
    expected = [highest(task.model, *place) for place in places]
    assert np.ptp(expected) > 0.03
    np.testing.assert_allclose(task.ground.height(*jnp.float32(places).T), expected, atol=1e-5)


@pytest.mark.parametrize(("kind", "last"), [("slopes", 2.4 * np.tan(np.radians(15))), ("steps", 0.6), ("rough", 0.1)])
def test_hills_of_a_kind_get_harder(kind, last):
    """Whether the kind is alone or takes turns with others, its last hill has the full height."""
    for ground, first in ((PRESETS[kind], 0), (PRESETS["mixed"], ["slopes", "steps", "rough"].index(kind))):
        heights = np.zeros(ground.rows)
        for part in sections(ground):
            row = int(part.start // ROW_LENGTH)
            heights[row] = max(heights[row], part.first, part.last)
        own = heights if ground is PRESETS[kind] else heights[first::3]
        assert (np.diff(own) > 0).all() or kind == "rough"
        assert own[-1] == pytest.approx(last, rel=0.15 if kind == "rough" else 1e-6) and own[0] < 0.5 * last


def test_episodes_start_at_the_feet_of_the_first_rows():
    task = make_env("humanoid", "c", ground=Ground(step_height=0.2, rows=4, first_rows=3))
    states = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
    x, y, z = np.asarray(states.physics.qpos[:, :3]).T
    assert set(np.round(2 * x) / 2) == {1.5, 10.5, 19.5}
    assert -4.1 < y.min() < -2 and 2 < y.max() < 4.1
    np.testing.assert_allclose(z, 1.4, atol=0.011)  # a reset's noise
    np.testing.assert_allclose(states.obs[:, 0], z)


def test_height_counts_from_the_ground():
    """A walker stands on a top of 1 m, where its height would be too large on the floor."""
    task = make_env("walker2d", "c", ground=Ground(step_height=0.2, rows=1, first_rows=1), reset_noise_scale=0)
    qpos = task.init_qpos.at[0].set(TOP).at[1].add(6 * 0.2)
    state = task.reset_to(qpos, task.init_qvel)
    assert state.obs[0] == pytest.approx(1.25)
    after = jax.jit(task.step)(state, jnp.zeros(task.action_size))
    assert after.physics.qpos[1] > 2.4 and not after.terminated and after.obs[0] == pytest.approx(1.25, abs=0.01)
    inside = jax.jit(task.step)(task.reset_to(task.init_qpos.at[0].set(TOP), task.init_qvel), jnp.zeros(6))
    assert inside.terminated


@pytest.mark.parametrize("engine", slow_except(["c"], ["c", "warp"]))
def test_steps_equal_those_of_mujoco(engine):
    """Walkers fall on ramps, steps and bars."""
    task = make_env("walker2d", engine, ground=Ground(slope=20.0, step_height=0.15, roughness=0.2, rows=3))
    rng = np.random.default_rng(0)
    x = np.float32(rng.uniform(0, 27, 24))
    height = task.ground.height(jnp.asarray(x), jnp.zeros(24)) + jnp.float32(rng.uniform(0.1, 0.3, 24))
    qpos = jnp.tile(task.init_qpos, (24, 1)).at[:, 0].set(x).at[:, 1].set(height).at[:, 2].set(1.5)
    qvel = jnp.float32(rng.normal(size=(24, task.model.nv)))
    states = jax.jit(jax.vmap(task.reset_to))(qpos, qvel)
    action = jnp.float32(rng.uniform(-1, 1, (24, task.action_size)))
    found = jax.jit(jax.vmap(task.step))(states, action).physics.qvel
    data = mujoco.MjData(task.model)
    touches = 0
    for i in range(24):
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = qpos[i], qvel[i], action[i], 0.0
        mujoco.mj_step(task.model, data, task.num_substeps())
        touches += any(task.model.geom_type[data.contact.geom[:, 0]] == mujoco.mjtGeom.mjGEOM_BOX)
        touches += any(task.model.geom_type[data.contact.geom[:, 1]] == mujoco.mjtGeom.mjGEOM_BOX)
        np.testing.assert_allclose(found[i], data.qvel, rtol=1e-3, atol=2e-3)
    assert touches > 9


def test_a_robot_on_hills(tmp_path):
    """Its feet touch a hill as they touch the floor, and it has fallen where its torso is in a hill."""
    robot = small_robot.write(tmp_path, small_robot.small_robot(actuator="motor"))
    task = make_env("locomotion", "c", xml_file=robot, ground=Ground(step_height=0.1, rows=1, first_rows=1))
    flat = make_env("locomotion", "c", xml_file=robot)
    observed = []
    for one, place, rise in ((flat, 0.0, 0.0), (task, TOP, 0.6)):
        qpos = one.init_qpos.at[0].set(place).at[2].add(rise)
        state, step = one.reset_to(qpos, one.init_qvel), jax.jit(one.step)
        for _ in range(25):
            state = step(state, jnp.asarray(one.robot.targets, jnp.float32))
        assert not state.terminated and not state.memory["air_time"].any()
        observed.append(state.obs)
    np.testing.assert_allclose(*observed, atol=2e-3)
    assert step(task.reset_to(task.init_qpos.at[0].set(TOP), task.init_qvel), task.action_low).terminated


def test_contact_pairs_of_the_floor_hold_for_the_hills(tmp_path):
    text = """<mujoco><worldbody>
      <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
      <body name="ball" pos="0 0 1"><freejoint/><geom name="ball" size=".1" contype="0" conaffinity="0"/>
        <body><joint name="j" range="-9 9"/><geom size=".01" contype="0" conaffinity="0"/></body></body>
      </worldbody><contact><pair geom1="ball" geom2="floor" condim="1" solref=".03 1"/></contact>
      <actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>"""
    (tmp_path / "m.xml").write_text(text)
    model = make_env("humanoid_standup", "c", xml_file=str(tmp_path / "m.xml"), ground="slopes").model
    assert model.npair == 31 and set(model.pair_dim) == {1} and (model.pair_solref == [0.03, 1.0]).all()
    assert len({tuple(pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)}) == 31


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (["env.ground=stairs"], "unknown env.ground 'stairs'; choose one of: slopes, steps"),
        (["env.ground.rows=3"], "env.ground.rows=3 has no effect with env.ground.slope=0.0"),
        (["env.ground.slope=50"], "env.ground.slope=50"),
    ],
)
def test_mistakes_in_settings_are_one_line(settings, says):
    with pytest.raises(UserError) as refused:
        load_config(["env=walker2d", *settings])
    assert says in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["swimmer", "reacher", "pusher", "inverted_double_pendulum"])
def test_bodies_that_do_not_walk(name):
    with pytest.raises(UserError, match=f"env.ground: {name} has no root that moves along x and up and down"):
        make_env(name, "c", ground="steps")


@pytest.mark.parametrize(
    ("floor", "says"),
    [
        ('<geom type="plane" size="1 1 1"/><geom type="plane" size="1 1 1" pos="0 0 -1"/>', "the model has 2"),
        ("", "the model has 0"),
        ('<geom type="plane" size="1 1 1" euler="0 5 0"/>', "the model's floor is tilted"),
    ],
)
def test_a_model_without_a_single_level_floor(floor, says, tmp_path):
    text = f"""<mujoco><worldbody>{floor}<body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <joint name="j"/><geom size=".1"/></body></worldbody>
      <actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>"""
    (tmp_path / "m.xml").write_text(text)
    with pytest.raises(UserError, match=says):
        make_env("half_cheetah", "c", xml_file=str(tmp_path / "m.xml"), ground="steps")


def test_a_reward_sees_the_height_above_the_ground(tmp_path, monkeypatch):
    """Also that of the state before the step, so that their difference is a velocity."""
    (tmp_path / "r.py").write_text("""
def rise(step):
    return {"reward_rise": step.after.qpos[1] - step.before.qpos[1], "reward_height": step.after.qpos[1]}
""")
    task = make_env("walker2d", "c", ground=Ground(step_height=0.2, rows=1), reward_function=f"{tmp_path}/r.py:rise")
    state = task.reset_to(task.init_qpos.at[0].set(TOP).at[1].add(6 * 0.2), task.init_qvel)
    metrics = jax.jit(task.step)(state, jnp.zeros(task.action_size)).metrics
    assert metrics["reward_height"] == pytest.approx(1.25, abs=0.01) and abs(metrics["reward_rise"]) < 0.01


class Overriding(Walker2d):
    def load_model(self):
        return mujoco.MjModel.from_xml_path(str(model_path(self.model_file)))


class Named(Walker2d):
    """Its model has a box with the name of a hill."""

    def load_model(self):
        spec = load_spec(self.model_file)
        spec.worldbody.add_geom(name="hill_0", type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.0, 1.0, 0.1], pos=[9.0, 0, 0])
        return spec.compile()


class Renamed(Walker2d):
    """It changes the names of its hills."""

    def load_model(self):
        spec = load_spec(self.model_file)
        self.ground.added_to(spec)
        for geom in spec.worldbody.geoms:
            geom.name = geom.name.replace("hill_", "ramp_")
        return spec.compile()


@pytest.mark.parametrize("task", [Overriding, Named])
def test_an_own_task_whose_model_has_no_hills(task):
    options = Walker2dOptions(ground=Ground(slope=10.0))
    with pytest.raises(
        UserError, match=r"load_model of its task does not add them; return self.ground.added_to\(spec\)"
    ):
        task(options, "c")


def test_an_own_task_may_rename_its_hills():
    model = Renamed(Walker2dOptions(ground=Ground(slope=10.0, rows=2)), "c").model
    assert model.geom("ramp_5").id > 0 and not any("hill" in model.geom(i).name for i in range(model.ngeom))


@pytest.mark.parametrize("name", ["walker2d", "locomotion"])
def test_a_model_with_hills_is_compiled_twice(name, tmp_path, monkeypatch):
    """Without the hills, whose place depends on the floor, and with them."""
    plane = '<geom type="plane" size="9 9 1"/>'
    robot = small_robot.small_robot(actuator='position ctrlrange="-3 3"', before=plane)
    path = small_robot.write(tmp_path, robot)
    compiled, from_spec, from_path = [], mujoco.MjSpec.compile, mujoco.MjModel.from_xml_path
    monkeypatch.setattr(mujoco.MjSpec, "compile", lambda spec: compiled.append(spec) or from_spec(spec))
    monkeypatch.setattr(mujoco.MjModel, "from_xml_path", lambda path: compiled.append(path) or from_path(path))
    make_env(name, "c", ground="steps", xml_file=path if name == "locomotion" else None)
    assert len(compiled) == 2


@pytest.mark.parametrize(
    ("old", "new"), [('name="torso" pos="0 0 1.25"', 'name="torso" pos="5 0 1.25"'), ('axis="1 0 0"', 'axis="0 1 0"')]
)
def test_a_root_whose_first_coordinate_is_not_its_place(old, new, tmp_path):
    text = model_path("walker2d_v5.xml").read_text()
    assert old in text
    (tmp_path / "m.xml").write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=r"qpos.0. of the model is not the root's x in the world"):
        make_env("walker2d", "c", xml_file=str(tmp_path / "m.xml"), ground="steps")


def test_names_of_the_model_and_its_extent_stay(tmp_path):
    text = model_path("walker2d_v5.xml").read_text().replace('name="torso_geom"', 'name="hill_3"')
    assert "hill_3" in text
    (tmp_path / "m.xml").write_text(text)
    flat, hilly = (
        make_env("walker2d", "c", xml_file=str(tmp_path / "m.xml"), ground=one) for one in (Ground(), "steps")
    )
    assert hilly.model.stat.extent == flat.model.stat.extent and hilly.model.ngeom == flat.model.ngeom + 110


def test_the_last_preset_counts():
    config = load_config(["env=walker2d", "env.ground=mixed", "env.ground.rows=4", "env.ground=steps"])
    assert config.env.ground == PRESETS["steps"]
    with pytest.raises(UserError, match=r"env.ground.rows=2 leaves no room for 3 kinds of hills"):
        make_env("walker2d", "c", ground=Ground(slope=9.0, step_height=0.1, roughness=0.1, rows=2))


def test_films_show_the_hills_and_scores_leave_them_out():
    task = make_env("walker2d", "c", ground="steps")
    assert make_gymnasium(task).unwrapped.model.ngeom == task.model.ngeom > 100
    assert "ground" not in task.gymnasium_kwargs()
