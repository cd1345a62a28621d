"""Write the metrics, checkpoints and policies of a run to its folder."""

import contextlib
import logging
import shlex
from collections.abc import Iterator

import jax

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.evaluation.saved_policies import best_policy
from mjx_walk.logs.loggers import MetricsWriter, WandbLog
from mjx_walk.logs.metrics import Row
from mjx_walk.settings.config import Config
from mjx_walk.settings.input_files import read_inputs, save_inputs
from mjx_walk.settings.saved_config import as_yaml, save_config
from mjx_walk.storage import checkpoint
from mjx_walk.storage.arrays import HostArrays
from mjx_walk.storage.background_saver import BackgroundSaver, Part
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.folders import discard
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.storage.scores import BEST, FINAL, MILESTONES
from mjx_walk.training.distributed import Processes
from mjx_walk.training.milestones import KeptPolicies, Snapshots, milestone_line
from mjx_walk.training.restoring import NUM_DEVICES, SEEDS_TOGETHER, device_folder
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PolicyParams

__all__ = ["Recorder", "reporting_failed_writes"]

_LOGGER = logging.getLogger(__name__)


class Recorder:
    """Writes one run's folder. Processes other than the main one save only their part of the checkpoints.

    Where a file cannot be written, or the folder has vanished, methods raise `UserError`.
    """

    def __init__(
        self, config: Config, algorithm: Algorithm, folder: RunFolder, processes: Processes, seeds_together: int = 1
    ):
        """
        Args:
            config: checked configuration.
            algorithm: algorithm of this run, on one device.
            folder: prepared run folder.
            processes: processes that train the run.
            seeds_together: runs that train in one program.
        """
        self._config = config
        self._inputs = read_inputs(algorithm.task)
        self._algorithm = algorithm
        self._folder = folder
        self._processes = processes
        self._seeds_together = seeds_together
        self._steps_per_iteration = algorithm.steps_per_iteration * processes.process_count
        self._checkpoints = device_folder(folder.checkpoints, processes.process_index)
        # A kill during a save leaves some folders one checkpoint ahead. All resume from the newest common one.
        is_saved_with_others = seeds_together > 1 or processes.process_count > 1
        self._saver = BackgroundSaver(
            self._checkpoints, config.checkpoint.max_to_keep, as_yaml(config), prune_first=is_saved_with_others
        )
        self._saved_best_iteration = -1
        self.snapshots = Snapshots() if config.checkpoint.milestones and processes.is_main_process else None
        """Policies from which milestones are chosen; None if the run keeps none."""
        self._writer: MetricsWriter | None = None
        self._wandb: WandbLog | None = None

    def begin(self, env_steps: int, will_train: bool, restored: Metadata) -> None:
        """Open the logs. Save the configuration of a resumed run, and read its snapshots of policies.

        Args:
            env_steps: environment steps at which the run resumes; later rows are dropped.
            will_train: whether iterations follow; they invalidate an old score and old milestones, which are removed.
            restored: metadata of the checkpoint from which the run resumes; empty for a new run.
        """
        if not self._processes.is_main_process:
            return
        with reporting_failed_writes(self._folder):
            if self._config.resume:
                save_config(self._config, self._folder.config)
            save_inputs(self._inputs, self._folder.inputs)
            resume_steps = env_steps if self._config.resume else None
            self._writer = MetricsWriter(self._folder.path, resume_steps, restored)
            self._wandb = WandbLog(self._config, self._folder) if self._config.wandb_project else None
            if will_train:
                self._folder.gymnasium_scores.unlink(missing_ok=True)
            for name in MILESTONES if will_train and self.snapshots else ():
                with contextlib.suppress(FileNotFoundError):
                    discard(self._folder.policy(name))
        if self.snapshots and restored:
            path = checkpoint.step_path(self._checkpoints, restored["env_steps"])
            like = jax.eval_shape(self._algorithm.policy_params, self._algorithm.state_shapes())
            self.snapshots = Snapshots.restore(path, restored, like)

    def write(self, row: Row) -> None:
        """Log a row."""
        if self._writer:
            with reporting_failed_writes(self._folder):
                self._writer.write(row)
        if self._wandb:
            self._wandb.write(row)

    def take_snapshot(self, policy_params: PolicyParams, env_steps: int) -> None:
        """Keep the present policy as a snapshot, if the run keeps milestones."""
        if self.snapshots:
            self.snapshots.take(policy_params, env_steps)

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
        further: HostArrays = {}
        if self.snapshots:
            further, metadata["snapshots"] = self.snapshots.arrays(), self.snapshots.env_steps.copy()
        parts = [Part(checkpoint.step_path(self._checkpoints, env_steps), state, metadata, further)]
        if self._processes.is_main_process:
            final = self._algorithm.policy_params(state)
            parts.insert(0, Part(self._folder.policy(FINAL), final, {"env_steps": env_steps}))
            best = best_policy(state, self._steps_per_iteration)
            if best and int(state.evaluation.best_iteration) != self._saved_best_iteration:
                self._saved_best_iteration = int(state.evaluation.best_iteration)
                parts.insert(0, Part(self._folder.policy(BEST), *best))
        with reporting_failed_writes(self._folder):
            if self._writer:
                self._writer.sync()
            self._saver.save(*parts)

    def save_policies(self, policies: KeptPolicies) -> None:
        """At the end of a training, start saving the milestones, and the final policy as the best one if it is that.

        Args:
            policies: the `final` and the `best` policy and the milestones, by name.
        """
        names = [name for name in MILESTONES if name in policies]
        if policies[BEST] is policies[FINAL]:
            names.append(BEST)
        if names:
            with reporting_failed_writes(self._folder):
                self._saver.save(*(Part(self._folder.policy(name), *policies[name]) for name in names))
        if self.snapshots:
            whose = f"Seed {self._config.seed}: " if self._seeds_together > 1 else ""
            _LOGGER.info(whose + milestone_line(policies))

    def wait(self) -> None:
        """Wait until the current save is on disk. Until every run has saved, the others may need the one before it."""
        with reporting_failed_writes(self._folder):
            self._saver.wait()

    def prune(self) -> None:
        """Remove old checkpoints and replay buffers."""
        with reporting_failed_writes(self._folder):
            self._saver.prune()

    def close_logs(self) -> None:
        """Close the logs. Checkpoints that are saved later record no position in them."""
        writer, self._writer = self._writer, None
        wandb, self._wandb = self._wandb, None
        if writer:
            with reporting_failed_writes(self._folder):
                writer.close()
        if wandb:
            wandb.close()

    def close(self) -> None:
        """Finish the checkpoint that is being written, and close the logs, however training has ended."""
        try:
            self.wait()
        finally:
            self.close_logs()


@contextlib.contextmanager
def reporting_failed_writes(folder: RunFolder) -> Iterator[None]:
    """Context manager that reports a failed write to a run folder in one line.

    Raises:
        UserError: a write failed.
    """
    try:
        yield
    except OSError as error:
        if error.filename == str(folder.path) or not folder.checkpoints.is_dir():
            raise UserError(f"{folder.path} has vanished with everything saved in it; training has stopped") from error
        reason = error.strerror or error
        raise UserError(
            f"cannot write {error.filename or folder.path}: {reason}; earlier checkpoints are complete; once it can be "
            f"written, continue with {shlex.quote(f'run_dir={folder.path}')} resume=true"
        ) from error
