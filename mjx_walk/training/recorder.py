"""What a run leaves in its folder while it trains: its rows, its checkpoints, its best policy, its scores."""

import math
import sys
from pathlib import Path
from typing import Any

from mjx_walk.envs import Task
from mjx_walk.evaluation.gymnasium_scores import Scores, score_in_gymnasium
from mjx_walk.runs import checkpoint
from mjx_walk.runs.config import Config, save_config
from mjx_walk.runs.loggers import MetricsWriter, WandbLog
from mjx_walk.runs.metrics import Row
from mjx_walk.runs.policies import deterministic_act
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.training.distributed import Team
from mjx_walk.training.distributed_checkpoint import NUM_DEVICES, device_folder, restore_newest
from mjx_walk.utils.types import Algorithm, TrainState
from mjx_walk.viewing.film import Filmer


class Recorder:
    """The disk's side of one run."""

    def __init__(self, config: Config, task: Task, algorithm: Algorithm, folder: RunFolder, team: Team | None = None):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            algorithm: of this run alone, on one device.
            folder: prepared run folder.
            team: the processes that train the run together.
        """
        self.config = config
        self._task = task
        self._algorithm = algorithm
        self._folder = folder
        self._team = team
        self._num_devices = team.size if team else 1
        self._saver = checkpoint.BackgroundSaver(self._checkpoints, config.checkpoint.keep)
        self._best_iteration = -1
        self._writer: MetricsWriter | None = None
        self._wandb: WandbLog | None = None
        self._filmer = Filmer(config, folder) if config.evaluation.films else None
        self._policies: list[tuple[Any, dict[str, Any]]] = []

    @property
    def _checkpoints(self) -> Path:
        return self._folder.checkpoints

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """The newest TrainState saved, and its `env_steps` and `wall_seconds`.

        Args:
            like: shapes of a TrainState.
        """
        state, facts = restore_newest(self._folder.checkpoints, like, self._team)
        if self._best_policy(state):
            self._best_iteration = int(state.env.live.best_iteration)
        return state, facts

    def begin(self, env_steps: int, trains_on: bool) -> None:
        """Open the log, after `env_steps` if the run is resumed, and keep the settings that it is resumed with; an old
        score is forgotten if the run trains on."""
        if self.config.resume:
            save_config(self.config, self._folder.config)
        self._writer = MetricsWriter(self._folder.path, env_steps if self.config.resume else None)
        self._wandb = WandbLog(self.config, self._folder) if self.config.wandb_project else None
        if trains_on:
            self._folder.gymnasium_scores.unlink(missing_ok=True)  # of a shorter run

    def write(self, row: Row) -> None:
        """Log a row."""
        assert self._writer
        self._writer.write(row)
        if self._wandb:
            self._wandb.write(row)

    def film(self, policy_params: Any, env_steps: int) -> None:
        """Film a policy, if that was asked for."""
        if self._filmer:
            self._filmer.take(policy_params, env_steps)

    def save(self, state: TrainState, env_steps: int, wall_seconds: float) -> None:
        """Begin to save the best policy, if it is a new one, and then the whole state, whose replay may take long.

        Before the first evaluation is over, the best policy is the present one.
        """
        parts = []
        best = self._best_policy(state)
        if not best:
            parts.append((self._folder.best_policy, self._algorithm.policy_params(state), {"env_steps": env_steps}))
        elif int(state.env.live.best_iteration) != self._best_iteration:
            self._best_iteration = int(state.env.live.best_iteration)
            parts.append((self._folder.best_policy, *best))
        self._saver.save(*parts, self._whole(state, env_steps, wall_seconds))

    def _whole(self, state: TrainState, env_steps: int, wall_seconds: float) -> tuple[Path, TrainState, dict[str, Any]]:
        """A checkpoint, as `BackgroundSaver.save` takes it."""
        facts = {"env_steps": env_steps, "wall_seconds": wall_seconds, NUM_DEVICES: self._num_devices}
        return checkpoint.step_path(self._checkpoints, env_steps), state, facts

    def end(self, state: TrainState, env_steps: int) -> None:
        """Close the log, draw it, and remember the policies that may be scored."""
        assert self._writer
        self._writer.close()
        if self._wandb:
            self._wandb.close()
        from mjx_walk.viewing.curves import plot_run  # Matplotlib, which training need not wait for when it begins

        try:
            plot_run(self._folder)
        except OSError as error:  # no reason not to score it
            print(f"warning: {self._folder.path} could not be drawn: {error}", file=sys.stderr)
        self._policies = [(self._algorithm.policy_params(state), {"env_steps": env_steps})]
        best = self._best_policy(state)
        if best:
            self._policies.append(best)

    def score(self, wall_seconds: float) -> Scores | None:
        """Score the last policy in the real Gymnasium, and write `eval_gymnasium.json`.

        Where an earlier one did better in the evaluations beside training, that one is scored too, and the better
        of the two is kept. Under a reward of one's own it is that earlier one alone.
        """
        num_episodes = self.config.evaluation.gymnasium_episodes
        if not num_episodes:
            return None
        scored: list[tuple[Scores, Any, dict[str, Any]]] = []
        # By a reward of one's own another policy may be the best than by Gymnasium's, which does not choose then.
        candidates = self._policies[-1:] if self._task.has_own_reward else self._policies
        for params, facts in candidates:
            if not scored or facts["eval_return"] > scored[0][0].mean:
                scored.append((self._score_in_gymnasium(params, num_episodes), params, facts))
        scores, params, facts = max(scored, key=lambda candidate: candidate[0].mean)
        scores.save(self._folder.gymnasium_scores, env_steps=facts["env_steps"], wall_seconds=wall_seconds)
        self._saver.save((self._folder.best_policy, params, facts))
        return scores

    def wait(self) -> None:
        """Until everything is on the disk."""
        self._saver.wait()
        if self._filmer:
            self._filmer.wait()

    def _score_in_gymnasium(self, policy_params: Any, num_episodes: int) -> Scores:
        return score_in_gymnasium(self._task, deterministic_act(self._algorithm, policy_params), num_episodes)

    def _best_policy(self, state: TrainState) -> tuple[Any, dict[str, Any]] | None:
        """The policy that did best in the evaluations beside training, and what is known of it."""
        live = state.env.live
        if math.isinf(live.best_return):
            return None
        env_steps = int(live.best_iteration) * self._algorithm.steps_per_iteration * self._num_devices
        return live.best_policy_params, {"env_steps": env_steps, "eval_return": float(live.best_return)}


class Follower(Recorder):
    """Of a team's other processes, which only keep what is their device's own."""

    @property
    def _checkpoints(self) -> Path:
        assert self._team
        return device_folder(self._folder.checkpoints, self._team.rank)

    def begin(self, env_steps: int, trains_on: bool) -> None:
        """Nothing: the first process logs."""

    def write(self, row: Row) -> None:
        """Nothing."""

    def film(self, policy_params: Any, env_steps: int) -> None:
        """Nothing."""

    def save(self, state: TrainState, env_steps: int, wall_seconds: float) -> None:
        """Begin to save the whole state."""
        self._saver.save(self._whole(state, env_steps, wall_seconds))

    def end(self, state: TrainState, env_steps: int) -> None:
        """Nothing."""

    def score(self, wall_seconds: float) -> Scores | None:
        """Nothing: the first process's policy is everyone's."""
        return None
