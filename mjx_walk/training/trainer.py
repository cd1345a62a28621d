"""The host loop: call the compiled program, log, save, and score at the end."""

import contextlib
import functools
import logging
import signal
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_walk.algos import TrainState, learned_leaves, make_algorithm, without_replay
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
from mjx_walk.training.distributed import Processes, make_devices_program, per_device
from mjx_walk.training.programs import (
    Program,
    compile_together,
    make_seeds_program,
    make_single_program,
)
from mjx_walk.training.recorder import Recorder
from mjx_walk.training.seeds_together import have_saved, restore_together
from mjx_walk.training.speed import Speed
from mjx_walk.training.summary import end_lines, score_lines
from mjx_walk.utils.collectives import DEVICES
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Metrics

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
        self.config = config = configs[0]
        self._task = task
        self._folders = folders
        self._processes = processes or Processes()
        count = self._processes.process_count
        algorithm = make_algorithm(
            task,
            config.num_envs,
            per_device(config.evaluation, count),
            per_device(config.algo, count),
            axis_name=DEVICES if count > 1 else None,
        )
        self._algorithm = algorithm
        self._steps_per_iteration = algorithm.steps_per_iteration * count
        self.recorders = [
            Recorder(own, task, algorithm, folder, self._processes, len(configs))
            for own, folder in zip(configs, folders, strict=True)
        ]
        self.steps_per_call = self._steps_per_iteration * config.iterations_per_call
        self.num_calls = -(-config.total_steps // self.steps_per_call)
        self._program = self._make_program()
        self._keys = [jax.random.PRNGKey(own.seed) for own in configs]
        self._evaluate = jax.jit(
            lambda params, key: evaluate(task, algorithm.evaluator.num_envs, algorithm.policy(params), key)[0].mean()
        )
        self._on_metrics = on_metrics or (lambda row: None)
        self._started = time.monotonic()
        self._seconds_before = 0.0
        self._warned_of: set[str] = set()

    def _make_program(self) -> Program:
        algorithm = self._algorithm
        iterations, fused = self.config.iterations_per_call, not self._task.engine.calls_host
        if self._processes.process_count > 1:
            return make_devices_program(algorithm, self._processes, iterations)
        if len(self.recorders) > 1:
            return make_seeds_program(algorithm, len(self.recorders), iterations, fused)
        return make_single_program(algorithm, iterations, fused)

    def train(self) -> str | None:
        """Train to the end, or until a stop signal.

        Returns:
            None at the end, otherwise the name of the signal. The states are saved in both cases.

        Raises:
            UserError: training has diverged, so that a network, an optimizer or a running statistic is not finite.
        """
        restored, call = self._restored()
        self._say_total(call)
        progress = Progress(
            self.num_calls * self.steps_per_call, call * self.steps_per_call, self._processes.is_main_process
        )
        state = restored if restored is not None and call >= self.num_calls else self._ready_to_call(restored)
        saved_call = call or -1
        speed = Speed(call)
        for recorder in self.recorders:
            recorder.begin(call * self.steps_per_call, will_train=call < self.num_calls)
        diverged = False
        profiled = self.config.profile_calls if self._processes.is_main_process else 0
        with Interrupt() as interrupt, CallProfile(self._folders[0].profile, profiled) as profile:
            while call < self.num_calls and not self._stop_signal(interrupt) and not diverged:
                profile.next_call()
                state, metrics = self._program.step(state)
                call += 1
                rows = self._rows(call, metrics, speed)  # waits for the call, so that the row has its end time
                self._write(state, rows, progress)
                diverged = not self._program.is_finite(state).all()
                if call % self.config.checkpoint.every_calls == 0:
                    progress.show_stage("saving")
                    self._save(state, call)
                    saved_call = call
            signal_name = self._stop_signal(interrupt)
            if saved_call != call:
                progress.show_stage("saving")
                self._save(state, call)
        progress.close()
        self._end(state, call, is_stopped=bool(signal_name or diverged))
        if diverged:
            raise UserError(
                f"training has diverged: after {call * self.steps_per_call:,} steps {self._nonfinite(state)} is not "
                "finite; earlier checkpoints are kept; lower the learning rate or clip gradients, then resume or start "
                "a new run"
            )
        return signal_name

    def _say_total(self, call: int) -> None:
        """Log whether the run is finished already, and the steps that it really trains."""
        total, steps = self.config.total_steps, self.num_calls * self.steps_per_call
        if not self._processes.is_main_process:
            return
        if call >= self.num_calls:
            _LOGGER.info(f"The run has already completed its {steps:,} steps; to continue, give a larger total_steps")
        elif steps != total:
            _LOGGER.info(f"total_steps={total:,} is rounded up to {steps:,}: a call has {self.steps_per_call:,} steps")

    def score(self) -> None:
        """Score every run in the real Gymnasium with `Recorder.score`, and log the last lines of the training.

        On return or error, all saves are complete.
        """
        seconds = self._seconds()  # equal for all runs, in whatever order they are scored
        num_episodes = self.config.evaluation.gymnasium_episodes
        is_main = self._processes.is_main_process
        if num_episodes and is_main:
            where = "Gymnasium, on the CPU" if self._task.is_in_gymnasium else f"physics={self._task.engine.name}"
            episodes = "episode" if num_episodes == 1 else "episodes"
            _LOGGER.info("Scoring %d %s of each policy in %s", num_episodes, episodes, where)
        try:
            for recorder in self.recorders:
                seed = recorder.config.seed if len(self.recorders) > 1 else None
                for line in score_lines(recorder.score(seconds), self.num_calls * self.steps_per_call, seed):
                    _LOGGER.info(line)
        finally:
            for recorder in self.recorders:
                recorder.wait()
        paths = [folder.path for folder in self._folders]
        for line in end_lines(paths, seconds, self._seconds(), bool(num_episodes)) if is_main else ():
            _LOGGER.info(line)

    def close(self) -> None:
        """Finish the checkpoints that are being written, and close the logs, however training has ended."""
        with postponed("finishing the checkpoint"), contextlib.ExitStack() as closing:
            for recorder in self.recorders:
                closing.callback(recorder.close)

    def _restored(self) -> tuple[TrainState | None, int]:
        """The saved TrainState, if there is one, and the number of completed calls."""
        if not self.config.resume or not have_saved(self._folders):
            for folder in self._folders:
                if self.config.resume and folder.metrics.exists():
                    warnings.warn(f"{folder.path} has no checkpoint; training restarts from step 0", stacklevel=2)
            return None, 0
        restored = restore_together(self.recorders, self._algorithm.state_shapes())
        self._seconds_before = max(metadata["wall_seconds"] for _, metadata in restored)
        calls = restored[0][1]["env_steps"] // self.steps_per_call
        return self._program.merge([state for state, _ in restored]), calls

    def _ready_to_call(self, restored: TrainState | None) -> TrainState:
        """Compile the programs while the engine gets ready. Return the state for the next call."""
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

    def _end(self, state: TrainState, call: int, is_stopped: bool) -> None:
        """Close the run folders. A run that stops early waits for its saves here, since no scoring follows."""
        state = without_replay(state)
        for recorder, own in zip(self.recorders, self._program.split(state), strict=True):
            evaluate = functools.partial(self._mean_return, recorder.config.seed)
            recorder.end(own, call * self.steps_per_call, None if is_stopped else evaluate)
        if is_stopped or self._are_saved_together:
            self._wait_for_saves()
            for recorder in self.recorders:
                recorder.prune()

    def _mean_return(self, seed: int, policy_params: Any) -> float:
        """Mean return of a policy over as many new episodes as an inline evaluation has."""
        key = jax.random.fold_in(jax.random.PRNGKey(seed), _CLOSING_EVALUATION)
        with undisturbed("finishing the evaluation of the final policy"):
            return float(self._evaluate(policy_params, key))

    def _rows(self, call: int, metrics: Metrics, speed: Speed) -> list[Row]:
        of_runs = self._program.split_metrics(metrics)
        common = {"env_steps": call * self.steps_per_call, "wall_seconds": self._seconds()}
        speeds = {
            "speed/steps_per_second": speed.after(call) * self.steps_per_call,
            "speed/seeds_together": float(len(self.recorders)),
        }
        return [common | name_metrics(own, self._steps_per_iteration) | speeds for own in of_runs]

    def _write(self, state: TrainState, rows: list[Row], progress: Progress) -> None:
        """Log and display the rows of a call. Film the policies whose evaluation has ended."""
        for recorder, row in zip(self.recorders, rows, strict=True):
            recorder.write(row)
            self._warn_of_physics(row)
            self._on_metrics(row)
        if self.config.evaluation.films:
            for recorder, row, policy in zip(self.recorders, rows, self._program.policies(state), strict=True):
                if "eval/return" in row:
                    recorder.film(policy, int(row["env_steps"]))
        progress.update(mean_row(rows))

    def _warn_of_physics(self, row: Row) -> None:
        for metric, warning in physics_warnings(row, self.steps_per_call).items():
            if metric not in self._warned_of:
                self._warned_of.add(metric)
                _LOGGER.warning(f"{warning}; the metric {metric} has the count")

    def _seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started

    def _save(self, state: TrainState, call: int) -> None:
        """Save the TrainState of every run that is finite."""
        if self._are_saved_together:
            self._wait_for_saves()  # until then, the checkpoint before this one may be needed
        states = zip(self.recorders, self._program.split(state), self._program.is_finite(state), strict=True)
        for recorder, own, is_finite in states:
            if is_finite:
                recorder.save(own, call * self.steps_per_call, self._seconds())

    @property
    def _are_saved_together(self) -> bool:
        """Whether a checkpoint is saved in several folders."""
        return len(self.recorders) > 1 or self._processes.process_count > 1

    def _wait_for_saves(self) -> None:
        for recorder in self.recorders:
            recorder.wait()
        self._processes.wait_for_all()

    def _nonfinite(self, state: TrainState) -> str:
        """The first learned leaf that is not finite, and its seed, for each run that has one."""
        found = []
        for recorder, own in zip(self.recorders, self._program.split(without_replay(state)), strict=True):
            names = [name for name, leaf in learned_leaves(own).items() if not jnp.isfinite(leaf).all()]
            found += [f"{name} of seed {recorder.config.seed}" for name in names[:1]]
        return ", ".join(found)

    def _stop_signal(self, interrupt: Interrupt) -> str | None:
        """Name of the stop signal, from whichever process received it."""
        number = signal.Signals[interrupt.signal_name].value if interrupt.signal_name else 0
        number = self._program.max_over_processes(number)
        return signal.Signals(number).name if number else None
