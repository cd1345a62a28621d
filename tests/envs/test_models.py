"""Models from elsewhere: each equals Gymnasium's class under the same file, or is refused in one line."""

import importlib.util
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import jax
import mujoco
import numpy as np
import pytest
from helpers import CLONE, TINY, train_here

from mjx_walk.envs import GYMNASIUM_TASKS, TASKS, make_env
from mjx_walk.envs.models import load_model
from mjx_walk.envs.physics import PhysicsState
from mjx_walk.machine.quiet_mujoco import hide_deprecations
from mjx_walk.utils.errors import UserError

FOLDERS = {
    "Gymnasium": ("gymnasium", "envs/mujoco/assets"),
    "Brax": ("brax", "envs/assets"),
    "dm_control": ("dm_control", "suite"),
}
EQUAL = "equals Gymnasium"
MODELS = [
    ("Brax humanoid.xml", "humanoid", EQUAL),
    ("Brax ant.xml", "ant", EQUAL),
    ("Brax half_cheetah.xml", "half_cheetah", EQUAL),
    ("Brax walker2d.xml", "walker2d", EQUAL),
    ("Brax pusher.xml", "pusher", EQUAL),
    ("Brax inverted_double_pendulum.xml", "inverted_double_pendulum", EQUAL),
    ("dm_control humanoid.xml", "humanoid", EQUAL),
    ("dm_control humanoid.xml", "ant", EQUAL),
    ("dm_control walker.xml", "walker2d", EQUAL),
    ("dm_control cheetah.xml", "half_cheetah", EQUAL),
    ("dm_control hopper.xml", "hopper", EQUAL),
    ("dm_control swimmer.xml", "swimmer", "this one has no <actuator>"),
    ("dm_control quadruped.xml", "ant", EQUAL),
    ("dm_control dog.xml", "ant", EQUAL),
    ("Gymnasium ant.xml", "walker2d", EQUAL),
    ("Gymnasium humanoid.xml", "ant", EQUAL),
    ("Gymnasium point.xml", "ant", EQUAL),
    ("Gymnasium hopper.xml", "reacher", "the model has no body 'fingertip'"),
    ("Gymnasium ant.xml", "pusher", "the model has no body 'tips_arm'"),
    ("Gymnasium inverted_pendulum.xml", "humanoid", "at least 3 positions (nq); this one has 2"),
    ("Gymnasium walker2d_v5.xml", "inverted_double_pendulum", "at least 1 site(s); this one has 0"),
]
"""Model, task, and the result: `EQUAL`, or a part of the error."""


def path_of(model):
    """The file of a model in its installed package."""
    library, file = model.split()
    package, folder = FOLDERS[library]
    spec = importlib.util.find_spec(package)
    if spec is None:
        pytest.skip(f"{package} is not installed: pip install --no-deps {package}")
    return Path(spec.submodule_search_locations[0]) / folder / file


@pytest.mark.parametrize("memory", ["1K", "2K", "5K", "20K", "4M"])
def test_memory_suffices_or_is_refused(memory, tmp_path):
    """MuJoCo ends with an error where a file names little memory, or loses contacts where it names a little more."""
    text = path_of("Gymnasium hopper.xml").read_text().replace("<worldbody>", f'<size memory="{memory}"/><worldbody>')
    path = tmp_path / "hopper.xml"
    path.write_text(text)
    if memory == "4M":
        assert load_model(str(path)).narena == 4 * 2**20
        return
    with pytest.raises(UserError) as refused:
        load_model(str(path))
    advice = "remove memory, nstack, njmax and nconmax"
    assert str(refused.value) == f"{path}: its <size> leaves too little memory for its contacts and limits; {advice}"


def test_memory_that_suffices_only_at_first_is_refused(tmp_path):
    """Twenty boxes in a row lose contacts as soon as they have piled up."""
    boxes = "".join(
        f'<body pos="{i} 0 0.095"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>' for i in range(40)
    )
    path = tmp_path / "boxes.xml"
    for size, is_enough in (
        ('memory="4M"', False),
        ('njmax="50" nconmax="50"', False),
        ('memory="60M"', True),
        ("", True),
    ):
        path.write_text(
            f'<mujoco><size {size}/><worldbody><geom type="plane" size="9 9 1"/>{boxes}</worldbody></mujoco>'
        )
        if is_enough:
            load_model(str(path))
            continue
        with pytest.raises(UserError, match="leaves too little memory"):
            load_model(str(path))


def test_memory_that_mujoco_would_choose_is_enough(tmp_path):
    """A hundred boxes that all touch each other would need more, as they do without a `<size>`."""
    body = '<body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>'
    path = tmp_path / "boxes.xml"
    for size in ("", '<size memory="57M"/>'):
        path.write_text(f"<mujoco>{size}<worldbody>{body * 100}</worldbody></mujoco>")
        assert load_model(str(path)).narena == 57 * 2**20


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("model", "name", "result"),
    [pytest.param(*case, marks=[pytest.mark.dm_control] * case[0].startswith("dm_control")) for case in MODELS],
)
def test_equal_to_gymnasium_or_refused(model, name, result):
    path = str(path_of(model))
    if result != EQUAL:
        with pytest.raises(UserError) as refused:
            make_env(name, physics="c", xml_file=path)
        assert result in str(refused.value) and "\n" not in str(refused.value)
        return
    task = make_env(name, physics="c", xml_file=path)
    with hide_deprecations():
        real = gymnasium.make(task.gymnasium_id, xml_file=path).unwrapped
    real.reset(seed=0)
    qpos, qvel = np.float32(real.data.qpos), np.float32(real.data.qvel)
    real.set_state(np.float64(qpos), np.float64(qvel))
    real.data.qacc_warmstart[:] = 0
    state = task.reset_to(qpos, qvel)
    np.testing.assert_allclose(state.obs, real._get_obs(), rtol=1e-6, atol=1e-6)
    action = np.random.default_rng(0).uniform(1.2 * task.action_low, 1.2 * task.action_high)
    obs, reward, terminated, _, _ = real.step(np.float32(action))
    state = jax.jit(task.step)(state, np.float32(action))
    np.testing.assert_allclose(state.obs, obs, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(state.reward, reward, rtol=1e-5, atol=1e-4)
    assert bool(state.terminated) == terminated
    assert jax.eval_shape(task.reset, jax.random.PRNGKey(0)).obs.shape == (task.observation_size,)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "name"), [(model, name) for model, name, result in MODELS if result == EQUAL and name not in model]
)
def test_trains(model, name, tmp_path):
    """Models of other bodies. `tests/test_readme.py` trains on each task's own body."""
    train_here(tmp_path, f"env={name}", f"env.xml_file={path_of(model)}", "total_steps=128", tiny=TINY[1:])


def test_the_page_shows_this_table():
    rows = [line for line in (CLONE / "docs" / "your_own.md").read_text().splitlines() if line.startswith("| ")]
    shown = [tuple(cell.strip(" `") for cell in row.strip("|").split("|")) for row in rows]
    for model, name, result in MODELS:
        library, file = model.split()
        (said,) = (row[3] for row in shown if row[:3] == (library, file, name))
        said = said.replace("&lt;", "<").replace("&gt;", ">")
        assert said == result if result == EQUAL else said.startswith("refused: ") and result in said, (model, name)


def edited(tmp_path, old, new):
    """Gymnasium's walker2d with a change."""
    text = path_of("Gymnasium walker2d_v5.xml").read_text()
    assert old in text
    (tmp_path / "edited.xml").write_text(text.replace(old, new))
    return str(tmp_path / "edited.xml")


def test_motors_without_a_range_are_refused(tmp_path):
    source = 'ctrllimited="true" ctrlrange="-1.0 1.0" gear="100" joint="leg_joint"'
    path = edited(tmp_path, source, 'gear="100" name="shin" joint="leg_joint"')
    with pytest.raises(UserError, match=r"motor 'shin' of the model has no control range; set its ctrlrange.*HIGH\"$"):
        make_env("walker2d", physics="c", xml_file=path)


def test_servos_may_take_the_range_of_their_joint(tmp_path):
    """The error for a position servo without a range names `inheritrange`, which gives it its joint's range."""
    source = '<motor ctrllimited="true" ctrlrange="-1.0 1.0" gear="100" joint="leg_joint"/>'
    servo = '<position name="shin" kp="50" dampratio="1" joint="leg_joint" {}/>'
    with pytest.raises(UserError, match=r'set its ctrlrange="LOW HIGH", or inheritrange="1"$'):
        make_env("walker2d", physics="c", xml_file=edited(tmp_path, source, servo.format('ctrllimited="false"')))
    task = make_env("walker2d", physics="c", xml_file=edited(tmp_path, source, servo.format('inheritrange="1"')))
    knee = task.model.joint("leg_joint")
    np.testing.assert_allclose((task.action_low[1], task.action_high[1]), knee.range, rtol=1e-6)


@pytest.mark.parametrize(
    ("shaping", "says"),
    [({"backward": 1.0}, "has no x coordinate"), ({"keep_y": 1.0}, "has no y coordinate")],
)
def test_shaping_needs_the_coordinate_in_the_model(shaping, says):
    """Ant reads qpos[0] and qpos[1] as x and y, which they are not in a model whose root turns first."""
    make_env("ant", physics="c", shaping=shaping)
    with pytest.raises(UserError, match=says):
        make_env("ant", physics="c", shaping=shaping, xml_file="pusher_v5.xml", main_body=1)


def test_the_view_fits_the_model():
    assert all(make_env(name, physics="c").view == TASKS[name][0].VIEW for name in GYMNASIUM_TASKS)


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
@pytest.mark.parametrize("inside", ["", "<worldbody/>", "<worldbody><geom size='1'/><site name='s'/></worldbody>"])
def test_a_model_without_bodies_is_refused(tmp_path, name, inside):
    (tmp_path / "empty.xml").write_text(f"<mujoco>{inside}</mujoco>")
    with pytest.raises(UserError, match=r"(the model has no body|needs a model with)"):
        make_env(name, physics="c", xml_file=str(tmp_path / "empty.xml"))


ABSURD = [
    ('timestep="0.002"', 'timestep="0.002" gravity="0 0 -1e300"', "qacc"),
    ('ref="1.25"', 'ref="1e300"', "qpos"),
    ('ref="1.25" stiffness="0"', 'ref="1e10" springref="0" stiffness="1e300"', "qacc"),
]


@pytest.mark.parametrize(("old", "new", "name"), ABSURD)
def test_a_model_that_overflows_in_its_own_pose_is_refused(tmp_path, old, new, name):
    text = path_of("Gymnasium walker2d_v5.xml").read_text()
    assert old in text
    (tmp_path / "absurd.xml").write_text(text.replace(old, new))
    with pytest.raises(UserError, match=f"the model cannot be simulated: {name} is not finite in its own pose"):
        make_env("walker2d", physics="c", xml_file=str(tmp_path / "absurd.xml"))


def test_threads_step_one_task_in_turn():
    """MuJoCo's work space is shared: two threads in it at once would end the process."""
    task = make_env("walker2d", physics="c")
    state = PhysicsState(*(np.tile(x, (4, 1)) for x in (task.init_qpos, task.init_qvel, task.init_qvel)))
    alone = task.engine._host_step(state, np.zeros((4, 6)))
    turns, step_one = [], task.engine._step_one

    def counted(*arguments):
        turns.append(task.engine._lock.locked())
        step_one(*arguments)

    task.engine._step_one = counted
    with ThreadPoolExecutor(3) as threads:
        together = list(threads.map(lambda _: task.engine._host_step(state, np.zeros((4, 6))), range(30)))
    assert len(turns) == 120 and all(turns)
    for (qpos, *_), _, _ in together:
        np.testing.assert_array_equal(qpos, alone[0][0])


def test_an_unstable_simulation_writes_nothing_into_the_working_directory(tmp_path, monkeypatch):
    """MuJoCo's log would be written through a link that a downloaded folder has there."""
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "MUJOCO_LOG.TXT").symlink_to("precious")
    monkeypatch.chdir(tmp_path)
    model = load_model("hopper.xml")
    data = mujoco.MjData(model)
    data.qpos[:] = 1e300
    mujoco.mj_step(model, data)
    assert data.warning.number.any() and (tmp_path / "precious").read_text() == "mine"


@pytest.mark.parametrize("given", ["hopper.xml", "here/mine.xml", "./here/mine.xml", Path("here/mine.xml"), ""])
def test_gymnasium_gets_the_same_file(given, tmp_path, monkeypatch):
    """Gymnasium itself looks for a relative path among its assets."""
    assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "mine.xml").write_bytes((assets / "hopper.xml").read_bytes())
    monkeypatch.chdir(tmp_path)
    keywords = make_env("hopper", physics="c", xml_file=given).gymnasium_kwargs()
    expected = {"hopper.xml": assets / "hopper.xml", "": None}.get(given, tmp_path / "here" / "mine.xml")
    assert keywords == ({"xml_file": str(expected)} if expected else {})
