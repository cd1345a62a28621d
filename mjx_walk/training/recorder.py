"""Write the metrics, checkpoints, policies and scores of a run to its folder."""

import logging
import math
from typing import Any

from mjx_walk.algos import Algorithm, TrainState
from mjx_walk.envs import Task
from mjx_walk.evaluation.gymnasium_scores import Scores, score_in_gymnasium
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, save_config
from mjx_walk.runs.loggers import MetricsWriter, WandbLog
from mjx_walk.runs.metrics import Row
from mjx_walk.runs.policies import deterministic_act
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.training.distributed import Processes
from mjx_walk.training.distributed_checkpoint import NUM_DEVICES, device_folder, restore_newest
from mjx_walk.viewing.film import Filmer

_log = logging.getLogger(__name__)


class Recorder:
    """Writes one run's folder. Processes other than the main one save only their part of the checkpoints."""

    def __init__(self, config: Config, task: Task, algorithm: Algorithm, folder: RunFolder, processes: Processes):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            algorithm: algorithm of this run, on one device.
            folder: prepared run folder.
            processes: processes that train the run.
        """
        self.config = config
        self._task = task
        self._algorithm = algorithm
        self._folder = folder
        self._processes = processes
        self._checkpoints = device_folder(folder.checkpoints, processes.process_index)
        self._saver = checkpoint.BackgroundSaver(self._checkpoints, config.checkpoint.keep)
        self._best_iteration = -1
        self._writer: MetricsWriter | None = None
        self._wandb: WandbLog | None = None
        self._filmer = Filmer(config, folder) if config.evaluation.films else None
        self._policies: list[tuple[Any, dict[str, Any]]] = []

    @property
    def _is_main_process(self) -> bool:
        return self._processes.is_main_process

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """Restore the newest saved TrainState, and its `env_steps` and `wall_seconds`.

        Args:
            like: TrainState of shapes and dtypes.
        """
        state, facts = restore_newest(self._folder.checkpoints, like, self._processes)
        if self._best_policy(state):
            self._best_iteration = int(state.evaluation.best_iteration)
        return state, facts

    def begin(self, env_steps: int, will_train: bool) -> None:
        """Open the logs. Save the configuration of a resumed run.

        Args:
            env_steps: environment steps at which the run resumes; later rows are dropped.
            will_train: whether iterations follow; they invalidate an old score, which is then removed.
        """
        if not self._is_main_process:
            return
        if self.config.resume:
            save_config(self.config, self._folder.config)
        self._writer = MetricsWriter(self._folder.path, env_steps if self.config.resume else None)
        self._wandb = WandbLog(self.config, self._folder) if self.config.wandb_project else None
        if will_train:
            self._folder.gymnasium_scores.unlink(missing_ok=True)

    def write(self, row: Row) -> None:
        """Log a row."""
        if self._writer:
            self._writer.write(row)
        if self._wandb:
            self._wandb.write(row)

    def film(self, policy_params: Any, env_steps: int) -> None:
        """Film a policy, if the configuration asks for films."""
        if self._filmer and self._is_main_process:
            self._filmer.take(policy_params, env_steps)

    def save(self, state: TrainState, env_steps: int, wall_seconds: float) -> None:
        """Start to save the complete state, and first the best policy if it is new.

        Until the first evaluation ends, the current policy counts as the best. A state with a replay buffer may take
        long to save.
        """
        facts = {"env_steps": env_steps, "wall_seconds": wall_seconds, NUM_DEVICES: self._processes.process_count}
        parts: list[Any] = [(checkpoint.step_path(self._checkpoints, env_steps), state, facts)]
        best = self._best_policy(state)
        if not self._is_main_process:
            pass
        elif not best:
            present = self._algorithm.policy_params(state)
            parts.insert(0, (self._folder.best_policy, present, {"env_steps": env_steps}))
        elif int(state.evaluation.best_iteration) != self._best_iteration:
            self._best_iteration = int(state.evaluation.best_iteration)
            parts.insert(0, (self._folder.best_policy, *best))
        self._saver.save(*parts)

    def end(self, state: TrainState, env_steps: int) -> None:
        """Close the logs, draw the curves, and keep the policies that may be scored."""
        if not self._writer:
            return
        self._writer.close()
        if self._wandb:
            self._wandb.close()
        from mjx_walk.viewing.run_plots import plot_run  # imports Matplotlib, which slows the start

        try:
            plot_run(self._folder)
        except OSError as error:
            _log.warning(f"cannot draw the curves of {self._folder.path}: {error}; draw them with mjx_walk.plots")
        self._policies = [(self._algorithm.policy_params(state), {"env_steps": env_steps})]
        best = self._best_policy(state)
        if best:
            self._policies.append(best)

    def score(self, wall_seconds: float) -> Scores | None:
        """Score the last policy in the real Gymnasium, and write `eval_gymnasium.json`.

        An earlier policy with a higher inline evaluation is scored too, and the better score is kept. With a custom
        reward only that earlier policy is scored, because Gymnasium's reward is not the training objective.
        """
        num_episodes = self.config.evaluation.gymnasium_episodes
        if not num_episodes or not self._policies:
            return None
        scored: list[tuple[Scores, Any, dict[str, Any]]] = []
        candidates = self._policies[-1:] if self._task.has_custom_reward else self._policies
        for params, facts in candidates:
            if not scored or facts["eval_return"] > scored[0][0].mean:
                scored.append((self._score_in_gymnasium(params, num_episodes), params, facts))
        scores, params, facts = max(scored, key=lambda candidate: candidate[0].mean)
        scores.save(self._folder.gymnasium_scores, env_steps=facts["env_steps"], wall_seconds=wall_seconds)
        self._saver.save((self._folder.best_policy, params, facts))
        return scores

    def wait(self) -> None:
        """Wait until all files are on disk."""
        self._saver.wait()
        if self._filmer:
            self._filmer.wait()

    def _score_in_gymnasium(self, policy_params: Any, num_episodes: int) -> Scores:
        return score_in_gymnasium(self._task, deterministic_act(self._algorithm, policy_params), num_episodes)

    def _best_policy(self, state: TrainState) -> tuple[Any, dict[str, Any]] | None:
        """Policy with the highest inline evaluation, and its facts. None until the first evaluation ends."""
        evaluation = state.evaluation
        if math.isinf(evaluation.best_return):
            return None
        steps_per_iteration = self._algorithm.steps_per_iteration * self._processes.process_count
        env_steps = int(evaluation.best_iteration) * steps_per_iteration
        return evaluation.best_policy_params, {"env_steps": env_steps, "eval_return": float(evaluation.best_return)}
