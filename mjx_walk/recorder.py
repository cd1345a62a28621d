"""What a run leaves in its folder while it trains: its rows, its checkpoints, its best policy, its scores."""

import math
from typing import Any

from mjx_walk import checkpoint, plots
from mjx_walk.config import Config
from mjx_walk.envs import Task
from mjx_walk.evaluation import Scores, score_in_gymnasium
from mjx_walk.metrics import MetricsWriter, Row
from mjx_walk.policies import deterministic_act
from mjx_walk.run_folder import RunFolder
from mjx_walk.types import Algorithm, TrainState


class Recorder:
    """The disk's side of one run."""

    def __init__(self, config: Config, task: Task, algorithm: Algorithm, folder: RunFolder):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            algorithm: of this run alone.
            folder: prepared run folder.
        """
        self.config = config
        self._task = task
        self._algorithm = algorithm
        self._folder = folder
        self._saver = checkpoint.BackgroundSaver(folder.checkpoints, config.checkpoint.keep)
        self._best_update = -1
        self._writer: MetricsWriter | None = None
        self._policies: list[tuple[Any, dict[str, Any]]] = []

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """The newest TrainState saved, and its `env_steps` and `wall_seconds`.

        Args:
            like: shapes of a TrainState.
        """
        state, facts = checkpoint.restore_newest(self._folder.checkpoints, like)
        if self._best_policy(state):
            self._best_update = int(state.env.live.best_update)
        return state, facts

    def begin(self, env_steps: int, trains_on: bool) -> None:
        """Open the log, after `env_steps` if the run is resumed; an old score is forgotten if the run trains on."""
        self._writer = MetricsWriter(self._folder.path, env_steps if self.config.resume else None)
        if trains_on:
            self._folder.gymnasium_scores.unlink(missing_ok=True)  # of a shorter run

    def write(self, row: Row) -> None:
        """Log a row."""
        assert self._writer
        self._writer.write(row)

    def save(self, state: TrainState, env_steps: int, wall_seconds: float) -> None:
        """Begin to save the whole state; and the best policy, if it is a new one. Before the first evaluation is over,
        the best policy is the present one."""
        facts = {"env_steps": env_steps, "wall_seconds": wall_seconds}
        parts = [(checkpoint.step_path(self._folder.checkpoints, env_steps), state, facts)]
        best = self._best_policy(state)
        if not best:
            parts.append((self._folder.best_policy, self._algorithm.policy_params(state), {"env_steps": env_steps}))
        elif int(state.env.live.best_update) != self._best_update:
            self._best_update = int(state.env.live.best_update)
            parts.append((self._folder.best_policy, *best))
        self._saver.save(*parts)

    def end(self, state: TrainState, env_steps: int) -> None:
        """Close the log, draw it, and remember the policies that may be scored."""
        assert self._writer
        self._writer.close()
        plots.plot_run(self._folder.path)
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

    def _score_in_gymnasium(self, policy_params: Any, num_episodes: int) -> Scores:
        return score_in_gymnasium(self._task, deterministic_act(self._algorithm, policy_params), num_episodes)

    def _best_policy(self, state: TrainState) -> tuple[Any, dict[str, Any]] | None:
        """The policy that did best in the evaluations beside training, and what is known of it."""
        live = state.env.live
        if math.isinf(live.best_return):
            return None
        env_steps = int(live.best_update) * self._algorithm.steps_per_update
        return live.best_policy_params, {"env_steps": env_steps, "eval_return": float(live.best_return)}
