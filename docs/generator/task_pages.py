"""A page for each task, from its class, its options and its MuJoCo model."""

import dataclasses
from pathlib import Path

import mujoco

from generator.markdown import code, table
from generator.observations import clipped_to, entries
from generator.setting_tables import GROUPS, settings_table
from generator.task_texts import TEXTS, TaskText
from mjx_walk import zoo
from mjx_walk.envs import BUILT_IN_TASKS, TASKS, Task, make_env
from mjx_walk.utils import setting_fields

PAGES = Path(__file__).parents[1] / "tasks"
NAMES = tuple(name for name in BUILT_IN_TASKS if TASKS[name][0].XML_FILES["v5"])
"""Tasks with a page: those of this package that have a model of their own."""


def page(name: str) -> str:
    """The page of a task."""
    tasks = versions(name)
    task, text = tasks["v5"], TEXTS[name]
    parts = [
        f"# {type(task).__name__}",
        f"{text.goal} {_equivalent(task)}",
        *_picture(name, text),
        f"```\npython -m mjx_walk.train env={name}\n```",
        *_shipped_policies(name),
        _overview(tasks),
        "## Actions",
        _actions(task),
        "## Observation",
        _observation(task, text),
        "## Reward",
        _reward(task, text),
        "## Episodes",
        _episodes(task, text),
        "## Options",
        _options(name),
        *(["## Differences of v4", _differences(tasks, text)] if task.is_in_gymnasium else []),
    ]
    source = type(task).__module__.rpartition(".")[2]
    parts.append(f"Source: [`envs/{source}.py`](../../envs/{source}.py).")
    return "\n\n".join(parts) + "\n"


def _equivalent(task: Task) -> str:
    """The task's equivalent in Gymnasium, in a sentence."""
    if task.is_in_gymnasium:
        return f"It is Gymnasium's `{task.gymnasium_id}`. Numbers and tables are for v5."
    return "Gymnasium has no equivalent."


def versions(name: str) -> dict[str, Task]:
    """The task in each of its versions."""
    return {version: make_env(name, physics="c", version=version) for version in TASKS[name][0].XML_FILES}


def overview_of_all() -> str:
    """The table of all tasks."""
    rows = []
    for name in NAMES:
        tasks = versions(name)
        task = tasks["v5"]
        sizes = (task.observation_size, task.action_size, f"{task.max_episode_steps:,}")
        title = f"[{type(task).__name__}]({name}.md)"
        rows.append([title, code(name), ", ".join(tasks), *sizes, _integrator(task)])
    titles = ["Task", "`env=`", "Versions", ">Observations", ">Actions", ">Steps per episode", "Integrator"]
    return table(titles, rows)


def _picture(name: str, text: TaskText) -> list[str]:
    """The film of a shipped policy, if there is one."""
    return [f"![{text.goal.removesuffix('.')}]({name}.webp)"] if (PAGES / f"{name}.webp").exists() else []


def _shipped_policies(name: str) -> list[str]:
    own = [code(f"{zoo.PREFIX}{policy}") for policy in zoo.names() if policy.startswith(f"{name}-")]
    return [f"Policies that come with the package: {', '.join(own)}."] if own else []


def _integrator(task: Task) -> str:
    name = mujoco.mjtIntegrator(task.model.opt.integrator).name.removeprefix("mjINT_")
    return {"EULER": "Euler"}.get(name, name)


def _overview(tasks: dict[str, Task]) -> str:
    is_in_gymnasium = tasks["v5"].is_in_gymnasium
    rows = [
        ("Name on the command line", lambda task: code(f"env={task.options.name}")),
        *([("Name in Gymnasium", lambda task: code(f"mjx_walk/{task.gymnasium_id}"))] if is_in_gymnasium else []),
        ("Model", lambda task: code(task.XML_FILES[task.options.version])),
        ("Observation size", lambda task: task.observation_size),
        ("Action size", lambda task: task.action_size),
        ("Time limit, steps", lambda task: f"{task.max_episode_steps:,}"),
        ("Duration of a step, s", lambda task: f"{task.dt:g}"),
        ("Physics steps per step", lambda task: task.options.frame_skip),
        ("Physics time step, s", lambda task: f"{task.model.opt.timestep:g}"),
        ("Integrator", _integrator),
    ]
    cells = [[title, *(value(task) for task in tasks.values())] for title, value in rows]
    return table(["", *tasks], cells)


def _actions(task: Task) -> str:
    model, rows = task.model, []
    for i in range(model.nu):
        motor = model.actuator(i)
        joint = model.joint(int(motor.trnid[0]))
        unit = "N" if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else "N·m"
        low, high = motor.ctrlrange
        gear = f"{motor.gear[0] * motor.gainprm[0]:g}"
        rows.append([i, code(joint.name), f"{low:g}", f"{high:g}", gear, unit])
    note = "An action holds the controls of the motors. A motor clips its control to the range."
    titles = [">Index", "Motor on joint", ">Lowest", ">Highest", ">Force or torque at control 1", "Unit"]
    return f"{note}\n\n{table(titles, rows)}"


def _observation(task: Task, text: TaskText) -> str:
    rows = []
    for entry in entries(task):
        last = entry.first + entry.count - 1
        index = f"{entry.first}–{last}" if entry.count > 1 else entry.first
        rows.append([index, entry.name, entry.unit])
    limit = clipped_to(task)
    notes = [f"Velocities are clipped to ±{limit:g}."] if limit else []
    notes += [text.observation] if text.observation else []
    return "\n\n".join([*([" ".join(notes)] if notes else []), table([">Index", "Quantity", "Unit"], rows)])


def _reward(task: Task, text: TaskText) -> str:
    terms = task.gymnasium_reward_terms
    constant = f" plus {task.REWARD_OFFSET:g}" if task.REWARD_OFFSET else ""
    note = f"The reward is the sum of these terms{constant}."
    return f"{note}\n\n{table(['Term', 'Value'], [[code(term), text.rewards[term]] for term in terms])}"


def _episodes(task: Task, text: TaskText) -> str:
    limit = f"The time limit truncates an episode after {task.max_episode_steps:,} steps."
    return (
        f"- **Start.** Every episode starts {text.start}.\n- **Termination.** {text.termination}\n- **Limit.** {limit}"
    )


def _options(name: str) -> str:
    kind, schema = TASKS[name]
    common = {field.name for field in dataclasses.fields(GROUPS["task"][0])}
    own = [row.name for row in setting_fields.table(schema) if row.name not in common or row.name in _DEFAULTS_DIFFER]
    lines = settings_table(schema, "env.").splitlines()
    kept = [line for line in lines[2:] if line.split("`")[1].removeprefix("env.") in own]
    exclusive = [*((option, "v5") for option in kind.V5_ONLY), *((option, "v4") for option in kind.V4_ONLY)]
    notes = []
    for version in kind.XML_FILES if len(kind.XML_FILES) > 1 else ():
        only = [code(f"env.{option}") for option, taker in exclusive if taker == version]
        notes += [f"\n\nOnly {version} takes {', '.join(only)}."] if only else []
    note = "".join(notes)
    shared = (
        "All tasks also take the [common options](../configuration.md#task) and [shaping](../configuration.md#shaping)."
    )
    return "\n".join([*lines[:2], *kept]) + note + f"\n\n{shared}"


_DEFAULTS_DIFFER = ("frame_skip", "max_episode_steps")
"""Common options whose defaults depend on the task."""


def _differences(tasks: dict[str, Task], text: TaskText) -> str:
    if "v4" not in tasks:
        (reason,) = tasks["v5"].MISSING_VERSIONS.values()
        return f"There is no v4: {reason}."
    old, new = tasks["v4"], tasks["v5"]
    notes = [f"`env.version=v4` trains Gymnasium's `{old.gymnasium_id}`."]
    if old.XML_FILES["v4"] != new.XML_FILES["v5"]:
        notes.append(f"The model is `{old.XML_FILES['v4']}` instead of `{new.XML_FILES['v5']}`.")
    if old.observation_size != new.observation_size:
        notes.append(f"The observation has {old.observation_size} numbers instead of {new.observation_size}.")
    before, after = old.gymnasium_reward_terms, new.gymnasium_reward_terms
    if set(before) != set(after):
        notes.append(f"The reward terms are {', '.join(map(code, before))}.")
    if not old.V4_INFO_HAS_TERMS:
        notes.append("`info` does not hold the reward terms.")
    notes.append("`info` of a reset is empty.")
    missing = [term for term in before if term not in after]
    page = "\n".join(f"- {note}" for note in (*notes, *text.v4))
    if missing:
        rows = [[code(term), text.rewards[term]] for term in missing]
        page += f"\n\n{table(['Term of v4', 'Value'], rows)}"
    return page
