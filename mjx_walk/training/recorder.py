"""What a run leaves in its folder while it trains: rows, checkpoints, policies and scores."""

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
    """The run folder of one run. Processes other than the main one save only their part of the checkpoints."""

    def __init__(self, config: Config, task: Task, algorithm: Algorithm, folder: RunFolder, processes: Processes):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            algorithm: of this run alone, on one device.
            folder: prepared run folder.
            processes: that train the run.
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
        """The newest saved TrainState, and its `env_steps` and `wall_seconds`.

        Args:
            like: shapes of a TrainState.
        """
        state, facts = restore_newest(self._folder.checkpoints, like, self._processes)
        if self._best_policy(state):
            self._best_iteration = int(state.evaluation.best_iteration)
        return state, facts

    def begin(self, env_steps: int, will_train: bool) -> None:
        """Open the logs, and save the configuration of a resumed run.

        Args:
            env_steps: where the run resumes; rows after it are dropped.
            will_train: whether iterations follow, which make an old score outdated.
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
        """Start to save the best policy, if it is new, and then the whole state, whose replay may take long.

        Before the first evaluation has ended, the best policy is the present one.
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
        """Close the logs, draw them, and keep the policies that may be scored."""
        if not self._writer:
            return
        self._writer.close()
        if self._wandb:
            self._wandb.close()
        from mjx_walk.viewing.curves import plot_run  # Matplotlib, which training need not wait for at its start

        try:
            plot_run(self._folder)
        except OSError as error:
            _log.warning(f"{self._folder.path} could not be drawn: {error}")
        self._policies = [(self._algorithm.policy_params(state), {"env_steps": env_steps})]
        best = self._best_policy(state)
        if best:
            self._policies.append(best)

    def score(self, wall_seconds: float) -> Scores | None:
        """Score the last policy in the real Gymnasium, and write `eval_gymnasium.json`.

        If an earlier policy did better in the inline evaluations, it is scored too, and the better score is kept.
        Under a reward of the user's own, only that earlier policy is scored: Gymnasium's reward cannot choose there.
        """
        num_episodes = self.config.evaluation.gymnasium_episodes
        if not num_episodes or not self._policies:
            return None
        scored: list[tuple[Scores, Any, dict[str, Any]]] = []
        candidates = self._policies[-1:] if self._task.has_own_reward else self._policies
        for params, facts in candidates:
            if not scored or facts["eval_return"] > scored[0][0].mean:
                scored.append((self._score_in_gymnasium(params, num_episodes), params, facts))
        scores, params, facts = max(scored, key=lambda candidate: candidate[0].mean)
        scores.save(self._folder.gymnasium_scores, env_steps=facts["env_steps"], wall_seconds=wall_seconds)
        self._saver.save((self._folder.best_policy, params, facts))
        return scores

    def wait(self) -> None:
        """Wait until everything is on the disk."""
        self._saver.wait()
        if self._filmer:
            self._filmer.wait()

    def _score_in_gymnasium(self, policy_params: Any, num_episodes: int) -> Scores:
        return score_in_gymnasium(self._task, deterministic_act(self._algorithm, policy_params), num_episodes)

    def _best_policy(self, state: TrainState) -> tuple[Any, dict[str, Any]] | None:
        """The policy with the highest inline evaluation, and its facts; None before the first has ended."""
        evaluation = state.evaluation
        if math.isinf(evaluation.best_return):
            return None
        steps_per_iteration = self._algorithm.steps_per_iteration * self._processes.process_count
        env_steps = int(evaluation.best_iteration) * steps_per_iteration
        return evaluation.best_policy_params, {"env_steps": env_steps, "eval_return": float(evaluation.best_return)}
