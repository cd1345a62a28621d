"""The host loop: call the compiled program, log, save, and score at the end."""

import functools
import logging
import signal
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_walk.algos import Algorithm, TrainState, learned_leaves, make_algorithm, without_replay
from mjx_walk.common.rollout import evaluate
from mjx_walk.envs import Task
from mjx_walk.envs.physics import nothing_runs
from mjx_walk.envs.vector_env import check_resets
from mjx_walk.logs.metrics import Row, mean_row, name_metrics, physics_warnings
from mjx_walk.logs.progress import Progress
from mjx_walk.machine.signals import Interrupt, postponed, undisturbed
from mjx_walk.settings.config import Config
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.call_profile import CallProfile
from mjx_walk.training.distributed import Processes, per_device
from mjx_walk.training.programs import compile_together, make_program
from mjx_walk.training.recorders import Recorders
from mjx_walk.training.speed import Speed
from mjx_walk.training.summary import end_lines
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Metrics

__all__ = ["Trainer"]

_LOGGER = logging.getLogger(__name__)

_CLOSING_EVALUATION = 2**31 - 1
"""Folded into a run's seed, so that the evaluation at the end has its own episodes."""


class Trainer:
    """Trains and scores one run, or several runs that differ only in their seed."""

    def __init__(
        self,
        configs: list[Config],
        task: Task,
        folders: list[RunFolder],
        on_metrics: Callable[[Row], None] | None = None,
        processes: Processes | None = None,
    ):
        """
        Args:
            configs: checked configurations that differ only in `seed` and `run_dir`.
            task: the unbatched environment.
            folders: prepared run folders, one for each configuration.
            on_metrics: called with every logged row.
            processes: processes that train one run together, with `num_envs` environments each.
        """
        self._config = config = configs[0]
        self._task = task
        self._folders = folders
        self._processes = processes = processes or Processes()
        count = processes.process_count
        evaluation, algo = per_device(config.evaluation, count), per_device(config.algo, count)
        self._algorithm = make_algorithm(task, config.num_envs, evaluation, algo, axis_name=processes.axis_name)
        self._program = make_program(self._algorithm, config.iterations_per_call, len(configs), processes)
        self._recorders = Recorders(configs, task, self._algorithm, folders, processes)
        self._steps_per_iteration = self._algorithm.steps_per_iteration * count
        self._steps_per_call = self._steps_per_iteration * config.iterations_per_call
        self._num_calls = -(-config.total_steps // self._steps_per_call)
        self._seeds = [own.seed for own in configs]
        self._keys = [jax.random.PRNGKey(seed) for seed in self._seeds]
        self._evaluate = jax.jit(functools.partial(_returns, self._algorithm))
        self._on_metrics = on_metrics or (lambda row: None)
        self._started = time.monotonic()
        self._seconds_before = 0.0
        self._warned_of: set[str] = set()

    def train(self) -> str | None:
        """Train to the end, or until a stop signal.

        Returns:
            None at the end, otherwise the name of the signal. The states are saved in both cases.

        Raises:
            UserError: training has diverged, so that a network, an optimizer or a running statistic is not finite.
        """
        restored, call = self._restored()
        self._say_total(call)
        progress = self._make_progress(call)
        state = self._ready_to_call(restored, call)
        speed = Speed(call)
        self._recorders.begin(call * self._steps_per_call, will_train=call < self._num_calls)
        saved_call, is_finite = call or -1, True
        with Interrupt() as interrupt, self._make_profile() as profile:
            signal_name = self._stop_signal(interrupt)
            while call < self._num_calls and is_finite and not signal_name:
                profile.next_call()
                state, metrics = self._program.step(state)
                call += 1
                self._log(state, self._rows(call, metrics, speed), progress)
                is_finite = bool(self._program.is_finite(state).all())
                if call % self._config.checkpoint.every_calls == 0:
                    self._save(state, call, progress)
                    saved_call = call
                signal_name = self._stop_signal(interrupt)
            if saved_call != call:
                self._save(state, call, progress)
        progress.close()
        is_complete = is_finite and not signal_name
        self._recorders.end(
            self._program.split(without_replay(state)),
            call * self._steps_per_call,
            self._mean_return if is_complete else None,
        )
        if not is_finite:
            raise UserError(self._divergence(state, call))
        return signal_name

    def score(self) -> None:
        """Score every run in the real Gymnasium, and log the last lines of the training.

        On return or error, all saves are complete.
        """
        seconds = self._seconds()
        num_episodes = self._config.evaluation.gymnasium_episodes
        is_main = self._processes.is_main_process
        if num_episodes and is_main:
            where = "Gymnasium, on the CPU" if self._task.is_in_gymnasium else f"physics={self._task.engine.name}"
            episodes = "episode" if num_episodes == 1 else "episodes"
            _LOGGER.info("Scoring %d %s of each policy in %s", num_episodes, episodes, where)
        self._recorders.score(seconds, self._num_calls * self._steps_per_call)
        paths = [folder.path for folder in self._folders]
        for line in end_lines(paths, seconds, self._seconds(), bool(num_episodes)) if is_main else ():
            _LOGGER.info(line)

    def close(self) -> None:
        """Finish the checkpoints that are being written, and close the logs, however training has ended."""
        with postponed("finishing the checkpoint"):
            self._recorders.close()

    def _restored(self) -> tuple[TrainState | None, int]:
        """The saved TrainState, if there is one, and the number of completed calls."""
        restored = self._recorders.restore() if self._config.resume else []
        if not restored:
            return None, 0
        self._seconds_before = max(metadata["wall_seconds"] for _, metadata in restored)
        calls = restored[0][1]["env_steps"] // self._steps_per_call
        return self._program.merge([state for state, _ in restored]), calls

    def _say_total(self, call: int) -> None:
        """Log whether the run is finished already, and the steps that it really trains."""
        total, steps = self._config.total_steps, self._num_calls * self._steps_per_call
        if not self._processes.is_main_process:
            return
        if call >= self._num_calls:
            _LOGGER.info(f"The run has already completed its {steps:,} steps; to continue, give a larger total_steps")
        elif steps != total:
            _LOGGER.info(f"total_steps={total:,} is rounded up to {steps:,}: a call has {self._steps_per_call:,} steps")

    def _make_progress(self, call: int) -> Progress:
        total, done = self._num_calls * self._steps_per_call, call * self._steps_per_call
        return Progress(total, done, self._processes.is_main_process)

    def _make_profile(self) -> CallProfile:
        num_calls = self._config.profile_calls if self._processes.is_main_process else 0
        return CallProfile(self._folders[0].profile, num_calls)

    def _ready_to_call(self, restored: TrainState | None, call: int) -> TrainState:
        """The state for the next call, if there is one. Compiles the programs while the engine gets ready."""
        if restored is not None and call >= self._num_calls:
            return restored
        with nothing_runs():
            programs = self._program.lower(self._keys, restored)
        self._task.engine.preparation.begin()  # not before, since it would slow the tracing down
        compile_together(programs)
        self._task.engine.preparation.wait()
        if restored is not None:
            return restored
        state = self._program.init(self._keys)
        check_resets(state.env)
        return state

    def _stop_signal(self, interrupt: Interrupt) -> str | None:
        """Name of the stop signal, from whichever process received it."""
        number = signal.Signals[interrupt.signal_name].value if interrupt.signal_name else 0
        number = max(self._processes.all_gather(number))
        return signal.Signals(number).name if number else None

    def _rows(self, call: int, metrics: list[Metrics], speed: Speed) -> list[Row]:
        """The row of each run at the end of a call."""
        common = {"env_steps": call * self._steps_per_call, "wall_seconds": self._seconds()}
        speeds = {
            "speed/steps_per_second": speed.after(call) * self._steps_per_call,
            "speed/seeds_together": float(len(self._seeds)),
        }
        return [common | name_metrics(own, self._steps_per_iteration) | speeds for own in metrics]

    def _log(self, state: TrainState, rows: list[Row], progress: Progress) -> None:
        """Log and display the rows of a call. Film the policies whose evaluation has ended."""
        self._recorders.write(rows)
        for row in rows:
            self._warn_of_physics(row)
            self._on_metrics(row)
        if self._config.evaluation.films and any("eval/return" in row for row in rows):
            self._recorders.film(self._program.split(self._algorithm.policy_params(state)), rows)
        progress.update(mean_row(rows))

    def _warn_of_physics(self, row: Row) -> None:
        for metric, warning in physics_warnings(row, self._steps_per_call).items():
            if metric not in self._warned_of:
                self._warned_of.add(metric)
                _LOGGER.warning(f"{warning}; the metric {metric} has the count")

    def _save(self, state: TrainState, call: int, progress: Progress) -> None:
        """Save the TrainState of every run that is finite."""
        progress.show_stage("saving")
        self._recorders.wait_for_saves()
        states, are_finite = self._program.split(state), self._program.is_finite(state)
        self._recorders.save(states, are_finite, call * self._steps_per_call, self._seconds())

    def _mean_return(self, seed: int, policy_params: Any) -> float:
        """Mean return of a policy over as many new episodes as an inline evaluation has."""
        key = jax.random.fold_in(jax.random.PRNGKey(seed), _CLOSING_EVALUATION)
        with undisturbed("finishing the evaluation of the final policy"):
            return float(self._evaluate(policy_params, key))

    def _divergence(self, state: TrainState, call: int) -> str:
        """Name the runs that have diverged, each with its first learned leaf that is not finite."""
        found = []
        for seed, own in zip(self._seeds, self._program.split(without_replay(state)), strict=True):
            names = [name for name, leaf in learned_leaves(own).items() if not jnp.isfinite(leaf).all()]
            found += [f"{name} of seed {seed}" for name in names[:1]]
        return (
            f"training has diverged: after {call * self._steps_per_call:,} steps {', '.join(found)} is not finite; "
            "earlier checkpoints are kept; lower the learning rate or clip gradients, then resume or start a new run"
        )

    def _seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started


def _returns(algorithm: Algorithm, policy_params: Any, key: jax.Array) -> jax.Array:
    """Mean return of a policy in as many environments as the inline evaluation has."""
    returns, _ = evaluate(algorithm.task, algorithm.evaluator.num_envs, algorithm.policy(policy_params), key)
    return returns.mean()
