"""The host loop: call the compiled program, log, save, and score at the end."""

import contextlib
import logging
import signal
import time
from collections.abc import Callable

import jax

from mjx_walk.algos import Algorithm, TrainState, without_replay
from mjx_walk.envs.physics import nothing_runs
from mjx_walk.envs.vector_env import check_resets
from mjx_walk.logs.metrics import Row, mean_row, name_metrics, physics_warnings
from mjx_walk.logs.progress import Progress, Speed
from mjx_walk.machine.signals import Interrupt, postponed
from mjx_walk.settings.config import Config
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.training.call_profile import CallProfile
from mjx_walk.training.distributed import Processes
from mjx_walk.training.goal import Goal
from mjx_walk.training.init_from import Networks, begin_with
from mjx_walk.training.messages import divergence, end_lines, say_length
from mjx_walk.training.milestones import KeptPolicies
from mjx_walk.training.programs import compile_together, make_program
from mjx_walk.training.recorder import Recorder
from mjx_walk.training.restoring import restore_runs
from mjx_walk.training.scoring import closing_policies, score_runs
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Metrics
from mjx_walk.viewing.film import Filmer

__all__ = ["Trainer"]

_LOGGER = logging.getLogger(__name__)


class Trainer:
    """Trains and scores one run, or several runs that differ only in their seed."""

    def __init__(
        self,
        configs: list[Config],
        algorithm: Algorithm,
        folders: list[RunFolder],
        processes: Processes,
        on_metrics: Callable[[Row], None] | None = None,
        networks: Networks | None = None,
    ):
        """
        Args:
            configs: checked configurations that differ only in `seed` and `run_dir`.
            algorithm: algorithm of one run, on one device.
            folders: prepared run folders, one for each configuration.
            processes: processes that train one run together, with `num_envs` environments each.
            on_metrics: called with every logged row.
            networks: what a new run begins with, by default random networks.
        """
        self._config = config = configs[0]
        self._algorithm = algorithm
        self._folders = folders
        self._processes = processes
        self._program = make_program(algorithm, config.iterations_per_call, len(configs), processes)
        self._recorders = [
            Recorder(own, algorithm, folder, processes, seeds_together=len(configs))
            for own, folder in zip(configs, folders, strict=True)
        ]
        films = config.evaluation.films and processes.is_main_process
        self._filmers = [Filmer(*run) for run in zip(configs, folders, strict=True)] if films else []
        self._steps_per_iteration = algorithm.steps_per_iteration * processes.process_count
        self._steps_per_call = self._steps_per_iteration * config.iterations_per_call
        self._first_steps = 0
        """Environment steps before a resume that are no multiple of a call, because the number of devices differed."""
        self._seeds = [own.seed for own in configs]
        self._keys = [jax.random.PRNGKey(seed) for seed in self._seeds]
        self._on_metrics = on_metrics or (lambda row: None)
        self._networks = networks
        self._goal = Goal(config.stop_at_return, len(configs))
        self._policies: list[KeptPolicies] = []
        """Policies of each run after a complete training, in the main process."""
        self._started = time.monotonic()
        self._seconds_before = 0.0
        self._warned_of: set[str] = set()

    def train(self) -> str | None:
        """Train to the end, or until a stop signal.

        Returns:
            None at the end, otherwise the name of the signal. `score` and `close` wait until the states are saved.

        Raises:
            UserError: training has diverged, so that a network, an optimizer or a running statistic is not finite.
        """
        restored, metadata = self._restored()
        call, self._first_steps = divmod(metadata[0].get("env_steps", 0), self._steps_per_call)
        if restored is not None:
            self._goal.recall(self._folders, self._env_steps(call))
        is_main = self._processes.is_main_process
        length = self._env_steps(self._num_calls), self._steps_per_call
        if is_main:
            say_length(self._config, *length, call >= self._num_calls, self._goal.is_reached)
        progress = Progress(self._env_steps(self._num_calls), self._env_steps(call), is_main)
        profile = CallProfile(self._folders[0].profile, self._config.profile_calls if is_main else 0)
        state = self._ready_to_call(restored, call)
        speed = Speed(call)
        for recorder, saved in zip(self._recorders, metadata, strict=True):
            recorder.begin(self._env_steps(call), not self._is_over(call), saved)
        self._take_snapshots(state, call)
        saved_call, is_finite = call if restored is not None else None, True
        with Interrupt() as interrupt, profile:
            signal_name = self._stop_signal(interrupt)
            while not self._is_over(call) and is_finite and not signal_name:
                profile.next_call()
                state, metrics = self._program.run_call(state)
                call += 1
                rows = self._rows(call, metrics, speed)
                self._log(rows)
                self._goal.take(rows, is_main)
                self._take_snapshots(state, call)
                self._film(state, rows)
                progress.update(mean_row(rows))
                is_finite = bool(self._program.is_finite(state).all())
                if call % self._config.checkpoint.every_calls == 0:
                    self._save(state, call, progress)
                    saved_call = call
                signal_name = self._stop_signal(interrupt)
            if saved_call != call:
                self._save(state, call, progress)
                signal_name = signal_name or self._stop_signal(interrupt)
        progress.close()
        self._finish(state, call, is_finite, is_complete=is_finite and not signal_name)
        if not is_finite:
            states = self._program.split(without_replay(state))
            raise UserError(divergence(states, self._seeds, self._env_steps(call)))
        return signal_name

    def score(self) -> None:
        """Score every run in the real Gymnasium, and log the last lines of the training.

        On return or error, all saves are complete.
        """
        seconds = self._seconds()
        task, num_episodes = self._algorithm.task, self._config.evaluation.gymnasium_episodes
        is_main = self._processes.is_main_process
        if num_episodes and is_main:
            where = "Gymnasium, on the CPU" if task.is_in_gymnasium else f"physics={task.engine.name}"
            _LOGGER.info(f"Scoring {num_episodes} episode{'s' * (num_episodes > 1)} of each policy in {where}")
        try:
            if num_episodes and self._policies:
                runs, total_steps = (self._policies, self._folders, self._seeds), self._env_steps(self._num_calls)
                score_runs(self._algorithm, *runs, num_episodes, seconds, total_steps)
        finally:
            self._wait_for_files()
        lines = end_lines(self._folders, seconds, self._seconds(), bool(num_episodes), bool(task.model_file))
        for line in lines if is_main else ():
            _LOGGER.info(line)

    def close(self) -> None:
        """Finish the checkpoints that are being written, and close the logs, however training has ended."""
        with postponed("finishing the checkpoint"), contextlib.ExitStack() as closing:
            for recorder in self._recorders:
                closing.callback(recorder.close)

    def _restored(self) -> tuple[TrainState | None, list[Metadata]]:
        """The saved TrainState, if there is one, and the metadata of each run; empty for a new run."""
        restored = restore_runs(self._folders, self._algorithm, self._processes) if self._config.resume else []
        if not restored:
            return None, [Metadata()] * len(self._seeds)
        self._seconds_before = max(metadata["wall_seconds"] for _, metadata in restored)
        return self._program.merge([state for state, _ in restored]), [metadata for _, metadata in restored]

    @property
    def _num_calls(self) -> int:
        return -(-(self._config.total_steps - self._first_steps) // self._steps_per_call)

    def _env_steps(self, call: int) -> int:
        """Environment steps of a run after so many calls."""
        return self._first_steps + call * self._steps_per_call

    def _is_over(self, call: int) -> bool:
        return call >= self._num_calls or self._goal.is_reached

    def _ready_to_call(self, restored: TrainState | None, call: int) -> TrainState:
        """The state for the next call, if there is one. Compiles the programs while the engine gets ready."""
        if restored is not None and self._is_over(call):
            return restored
        with nothing_runs():
            programs = self._program.lower(self._keys, restored)
        self._algorithm.task.engine.preparation.begin()  # not before, since it would slow the tracing down
        compile_together(programs)
        self._algorithm.task.engine.preparation.wait()
        if restored is not None:
            return restored
        state = self._program.init(self._keys)
        check_resets(state.env)
        if self._networks is None:
            return state
        states = [begin_with(self._algorithm, own, self._networks) for own in self._program.split(state)]
        return self._program.merge(states)

    def _stop_signal(self, interrupt: Interrupt) -> str | None:
        """Name of the stop signal, from whichever process received it."""
        number = signal.Signals[interrupt.signal_name].value if interrupt.signal_name else 0
        number = max(self._processes.all_gather(number))
        return signal.Signals(number).name if number else None

    def _rows(self, call: int, metrics: list[Metrics], speed: Speed) -> list[Row]:
        """The row of each run at the end of a call."""
        common = {"env_steps": self._env_steps(call), "wall_seconds": self._seconds()}
        speeds = {
            "speed/steps_per_second": speed.after(call) * self._steps_per_call,
            "speed/seeds_together": float(len(self._seeds)),
        }
        return [common | name_metrics(own, self._steps_per_iteration) | speeds for own in metrics]

    def _log(self, rows: list[Row]) -> None:
        """Log the rows, warn of physics that failed, and hand the rows to the caller."""
        for recorder, row in zip(self._recorders, rows, strict=True):
            recorder.write(row)
        for row in rows:
            for metric, warning in physics_warnings(row, self._steps_per_call).items():
                if metric not in self._warned_of:
                    self._warned_of.add(metric)
                    _LOGGER.warning(f"{warning}; the metric {metric} has the count")
            self._on_metrics(row)

    def _take_snapshots(self, state: TrainState, call: int) -> None:
        """Keep the present policies, from which milestones are chosen, if the configuration asks for it."""
        if self._config.checkpoint.milestones and self._processes.is_main_process:
            policies = self._program.split(self._algorithm.policy_params(state))
            for recorder, policy in zip(self._recorders, policies, strict=True):
                recorder.take_snapshot(policy, self._env_steps(call))

    def _film(self, state: TrainState, rows: list[Row]) -> None:
        """Film the policies of the runs whose inline evaluation has ended, if the configuration asks for it."""
        if not self._filmers or not any("eval/return" in row for row in rows):
            return
        policies = self._program.split(self._algorithm.policy_params(state))
        for filmer, policy, row in zip(self._filmers, policies, rows, strict=True):
            if "eval/return" in row:
                filmer.take(policy, int(row["env_steps"]))

    def _save(self, state: TrainState, call: int, progress: Progress) -> None:
        """Save the TrainState of every run that is finite."""
        progress.show_stage("saving")
        for recorder in self._recorders:
            recorder.wait()
        self._processes.wait_for_all()
        states, are_finite, seconds = self._program.split(state), self._program.is_finite(state), self._seconds()
        for recorder, own, is_finite in zip(self._recorders, states, are_finite, strict=True):
            if is_finite:
                recorder.save(own, self._env_steps(call), seconds)

    def _finish(self, state: TrainState, call: int, is_finite: bool, is_complete: bool) -> None:
        """Close the logs and draw the curves. After a complete training, choose the best policy of each run."""
        for recorder in self._recorders:
            recorder.close_logs()
        if self._processes.is_main_process:
            if is_complete:
                self._choose_policies(state, call)
            self._draw_curves()
        if is_complete and len(self._folders) * self._processes.process_count == 1:
            return  # a single folder is saved while the policies are scored
        self._wait_for_files()
        self._processes.wait_for_all()
        # After a divergence, only some runs may have saved. All need their newest common checkpoint.
        for recorder in self._recorders if is_finite else ():
            recorder.prune()

    def _choose_policies(self, state: TrainState, call: int) -> None:
        """Keep the policies of each run for `score`. Save the milestones, and the final one if it is the best."""
        runs = (self._program.split(without_replay(state)), [own.snapshots for own in self._recorders], self._seeds)
        self._policies = closing_policies(self._algorithm, *runs, self._env_steps(call), self._steps_per_iteration)
        for recorder, policies in zip(self._recorders, self._policies, strict=True):
            recorder.save_policies(policies)

    def _draw_curves(self) -> None:
        from mjx_walk.viewing.run_plots import plot_run  # imports Matplotlib, which slows the start

        for folder in self._folders:
            try:
                plot_run(folder)
            except (OSError, UserError) as error:
                _LOGGER.warning(f"cannot draw the curves of {folder.path}: {error}; draw them with mjx_walk.plots")

    def _wait_for_files(self) -> None:
        """Wait until all checkpoints and films are on disk."""
        for recorder in self._recorders:
            recorder.wait()
        for filmer in self._filmers:
            filmer.wait()

    def _seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started
