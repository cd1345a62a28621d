"""Write the metrics, checkpoints, policies and scores of a run to its folder."""

import contextlib
import logging
import shlex
from collections.abc import Callable, Iterator

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.envs import Task
from mjx_walk.evaluation.gymnasium_scores import score_in_gymnasium
from mjx_walk.evaluation.saved_policies import best_policy, deterministic_act, make_acting_algorithm
from mjx_walk.logs.loggers import MetricsWriter, WandbLog
from mjx_walk.logs.metrics import Row
from mjx_walk.settings.config import Config
from mjx_walk.settings.input_files import read_inputs, save_inputs
from mjx_walk.settings.saved_config import as_yaml, save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.background_saver import BackgroundSaver, Part
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, Scores, write_scores
from mjx_walk.training.distributed import Processes
from mjx_walk.training.distributed_checkpoint import NUM_DEVICES, SEEDS_TOGETHER, device_folder, restore_newest
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PolicyParams
from mjx_walk.viewing.film import Filmer

__all__ = ["Recorder"]

_LOGGER = logging.getLogger(__name__)


class Recorder:
    """Writes one run's folder. Processes other than the main one save only their part of the checkpoints.

    Where a file cannot be written, or the folder has vanished, methods raise `UserError`.
    """

    def __init__(
        self,
        config: Config,
        task: Task,
        algorithm: Algorithm,
        folder: RunFolder,
        processes: Processes,
        seeds_together: int = 1,
    ):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            algorithm: algorithm of this run, on one device.
            folder: prepared run folder.
            processes: processes that train the run.
            seeds_together: runs that train in one program.
        """
        self.config = config
        self._task = task
        self._inputs = read_inputs(task)
        self._algorithm = algorithm
        self._folder = folder
        self._processes = processes
        self._seeds_together = seeds_together
        self._steps_per_iteration = algorithm.steps_per_iteration * processes.process_count
        self._checkpoints = device_folder(folder.checkpoints, processes.process_index)
        # A kill may leave some of several folders one checkpoint ahead. They go back to the one before.
        is_saved_with_others = seeds_together > 1 or processes.process_count > 1
        self._saver = BackgroundSaver(
            self._checkpoints, config.checkpoint.max_to_keep, as_yaml(config), prune_first=is_saved_with_others
        )
        self._best_iteration = -1
        self._restored_metadata: Metadata = {}
        self._writer: MetricsWriter | None = None
        self._wandb: WandbLog | None = None
        self._filmer = Filmer(config, folder) if config.evaluation.films else None
        self._policies: dict[str, tuple[PolicyParams, Metadata]] = {}

    @property
    def _is_main_process(self) -> bool:
        return self._processes.is_main_process

    def restore(self, like: TrainState, at_most: int | None = None) -> tuple[TrainState, Metadata]:
        """Restore the newest saved TrainState, and its `env_steps`, `wall_seconds` and `seeds_together`.

        Args:
            like: TrainState of shapes and dtypes.
            at_most: environment steps that it may have at most.
        """
        state, metadata = restore_newest(self._folder.checkpoints, like, self._processes, at_most)
        self._restored_metadata = metadata
        return state, metadata

    def begin(self, env_steps: int, will_train: bool) -> None:
        """Open the logs. Save the configuration of a resumed run.

        Args:
            env_steps: environment steps at which the run resumes; later rows are dropped.
            will_train: whether iterations follow; they invalidate an old score, which is then removed.
        """
        if not self._is_main_process:
            return
        with self._writing():
            if self.config.resume:
                save_config(self.config, self._folder.config)
            save_inputs(self._inputs, self._folder.inputs)
            resume_steps = env_steps if self.config.resume else None
            self._writer = MetricsWriter(self._folder.path, resume_steps, self._restored_metadata)
            self._wandb = WandbLog(self.config, self._folder) if self.config.wandb_project else None
            if will_train:
                self._folder.gymnasium_scores.unlink(missing_ok=True)

    def write(self, row: Row) -> None:
        """Log a row."""
        if self._writer:
            with self._writing():
                self._writer.write(row)
        if self._wandb:
            self._wandb.write(row)

    def film(self, policy_params: PolicyParams, env_steps: int) -> None:
        """Film a policy, if the configuration asks for films."""
        if self._filmer and self._is_main_process:
            with self._writing():
                self._filmer.take(policy_params, env_steps)

    def save(self, state: TrainState, env_steps: int, wall_seconds: float) -> None:
        """Start saving the best policy if it is new, then the final policy, then the complete state.

        Saving a state with a replay buffer may take long.
        """
        metadata: Metadata = {
            "env_steps": env_steps,
            "wall_seconds": wall_seconds,
            NUM_DEVICES: self._processes.process_count,
            SEEDS_TOGETHER: self._seeds_together,
        }
        if self._writer:
            metadata |= self._writer.position
        parts = [Part(checkpoint.step_path(self._checkpoints, env_steps), state, metadata)]
        if self._is_main_process:
            final = self._algorithm.policy_params(state)
            parts.insert(0, Part(self._folder.policy(FINAL), final, {"env_steps": env_steps}))
            best = best_policy(state, self._steps_per_iteration)
            if best and int(state.evaluation.best_iteration) != self._best_iteration:
                self._best_iteration = int(state.evaluation.best_iteration)
                parts.insert(0, Part(self._folder.policy(BEST), *best))
        with self._writing():
            if self._writer:
                self._writer.sync()
            self._saver.save(*parts)

    def end(self, state: TrainState, env_steps: int, evaluate: Callable[[PolicyParams], float] | None) -> None:
        """Close the logs, draw the curves, and keep the policies that are to be scored.

        Args:
            state: the last TrainState.
            env_steps: its environment steps.
            evaluate: mean return of a policy in the training's own engine, if training is complete. The evaluations
                during training have not reached the final policy yet, so it has its own evaluation here. If that is
                the highest one, the final policy is also the best.
        """
        if not self._writer:
            return
        self._close_logs()
        from mjx_walk.viewing.run_plots import plot_run  # imports Matplotlib, which slows the start

        try:
            plot_run(self._folder)
        except (OSError, UserError) as error:
            _LOGGER.warning(f"cannot draw the curves of {self._folder.path}: {error}; draw them with mjx_walk.plots")
        final = self._algorithm.policy_params(state)
        metadata: Metadata = {"env_steps": env_steps}
        best = best_policy(state, self._steps_per_iteration)
        if evaluate:
            metadata |= {"eval_return": evaluate(final)}
            if not best or metadata["eval_return"] > best[1]["eval_return"]:
                best = (final, metadata)
                with self._writing():
                    self._saver.save(Part(self._folder.policy(BEST), *best))
        self._policies = {FINAL: (final, metadata)} | ({BEST: best} if best else {})

    def score(self, wall_seconds: float) -> dict[str, tuple[Scores, int]]:
        """Score the final and the best policy in the real Gymnasium, and write `eval_gymnasium.json`.

        Both act in float32. The best policy was chosen by other episodes than those that are scored here.

        Returns:
            The scores and the environment steps of each policy, by its name. Without scoring, none.
        """
        num_episodes = self.config.evaluation.gymnasium_episodes
        if not num_episodes or not self._policies:
            return {}
        acting = make_acting_algorithm(self._task, self.config)
        scored: dict[str, tuple[Scores, int]] = {}
        blocks = {}
        for name, (params, metadata) in self._policies.items():
            if scored and metadata is self._policies[FINAL][1]:  # the final policy is also the best
                scores = scored[FINAL][0]
            else:
                scores = score_in_gymnasium(self._task, deterministic_act(acting, params), num_episodes)
            scored[name] = (scores, metadata["env_steps"])
            blocks[name] = scores.block(**metadata)
        with self._writing():
            write_scores(self._folder.gymnasium_scores, self._task.gymnasium_id, blocks, {"wall_seconds": wall_seconds})
        return scored

    def wait_for_save(self) -> None:
        """Wait until the last save is complete."""
        with self._writing():
            self._saver.wait()

    def wait(self) -> None:
        """Wait until all files are on disk."""
        self.wait_for_save()
        if self._filmer:
            self._filmer.wait()

    def prune(self) -> None:
        """Remove old checkpoints and replay buffers."""
        with self._writing():
            self._saver.prune()

    def close(self) -> None:
        """Finish the checkpoint that is being written, and close the logs, however training has ended."""
        try:
            self.wait_for_save()
        finally:
            self._close_logs()

    def _close_logs(self) -> None:
        writer, self._writer = self._writer, None
        if writer:
            with self._writing():
                writer.close()
        if self._wandb:
            self._wandb.close()
            self._wandb = None

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Context manager that reports a failed write in one line."""
        try:
            yield
        except OSError as error:
            folder = self._folder.path
            if error.filename == str(folder) or not self._folder.checkpoints.is_dir():
                raise UserError(f"{folder} has vanished with everything saved in it; training has stopped") from error
            reason = error.strerror or error
            raise UserError(
                f"cannot write {error.filename or folder}: {reason}; earlier checkpoints are complete; once it can be "
                f"written, continue with {shlex.quote(f'run_dir={folder}')} resume=true"
            ) from error
