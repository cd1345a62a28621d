"""The only host loop: run a chunk on the device, log it, evaluate, save."""

import collections
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_walk import checkpoint, plots
from mjx_walk.algos import make_algorithm
from mjx_walk.config import Config
from mjx_walk.envs import Task
from mjx_walk.evaluation import Scores, score_in_gymnasium
from mjx_walk.interrupt import Interrupt
from mjx_walk.metrics import MetricsWriter, Progress, Row, name_metrics
from mjx_walk.policies import deterministic_act
from mjx_walk.run_folder import RunFolder
from mjx_walk.types import Algorithm, Metrics, TrainState

Chunk = Callable[[TrainState], tuple[TrainState, Metrics]]

_SPEED_WINDOW = 10.0
"""Seconds that the logged speed is averaged over."""


def make_init(algorithm: Algorithm) -> Callable[[jax.Array], TrainState]:
    """Compile `key → TrainState`, without weak types, with which the first chunk would be compiled a second time."""

    def init(key):
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), algorithm.init(key))

    return jax.jit(init)


def make_chunk(algorithm: Algorithm, num_updates: int, fused: bool) -> Chunk:
    """Compile `num_updates` updates into one call.

    Args:
        algorithm: what to run.
        num_updates: updates a chunk.
        fused: collect and learn in one program. Engines that call back to the host are kept in a program of their
            own, because JAX does not keep such programs in its compile cache.

    Returns:
        `TrainState → (TrainState, metrics [num_updates])`. The state passed in is consumed.
    """

    def update(state, _):
        state, batch = algorithm.collect(state)
        return algorithm.learn(state, batch)

    if fused:
        return jax.jit(lambda state: jax.lax.scan(update, state, length=num_updates), donate_argnums=0)

    collect = jax.jit(algorithm.collect, donate_argnums=0)
    learn = jax.jit(algorithm.learn, donate_argnums=0)

    def chunk(state):
        rows = []
        for _ in range(num_updates):
            state, metrics = learn(*collect(state))
            rows.append(metrics)
        return state, jax.tree.map(lambda *xs: jnp.stack(xs), *rows)

    return chunk


class Trainer:
    """One run, from its configuration to its scores."""

    def __init__(self, config: Config, task: Task, folder: RunFolder, on_metrics: Callable[[Row], None] | None = None):
        """
        Args:
            config: checked configuration.
            task: the unbatched environment.
            folder: prepared run folder.
            on_metrics: called with every row that is logged.
        """
        self.config = config
        self.task = task
        self.folder = folder
        self.algorithm = make_algorithm(task, config.num_envs, config.evaluation, config.algo)
        self.steps_per_chunk = self.algorithm.steps_per_update * config.updates_per_chunk
        self.num_chunks = -(-config.total_steps // self.steps_per_chunk)
        self._chunk = make_chunk(self.algorithm, config.updates_per_chunk, fused=task.engine.name != "c")
        self._saver = checkpoint.BackgroundSaver(folder.checkpoints, config.checkpoint.keep)
        self._on_metrics = on_metrics or (lambda row: None)
        self._started = time.monotonic()
        self._times: collections.deque[tuple[float, int]] = collections.deque()
        self._seconds_before = 0.0
        self._best_update = -1
        self._has_warned = False

    def train(self) -> str | None:
        """Train to the end, or until a signal asks to stop.

        Returns:
            None at the end, else the name of the signal; the state is saved either way.
        """
        state, chunk = self._start()
        writer = MetricsWriter(self.folder.path, chunk * self.steps_per_chunk if self.config.resume else None)
        progress = Progress(self.num_chunks * self.steps_per_chunk, chunk * self.steps_per_chunk)
        saved_chunk = chunk if self.config.resume else -1
        self._times.append((time.monotonic(), chunk))
        if chunk < self.num_chunks:
            self.folder.gymnasium_scores.unlink(missing_ok=True)  # of a shorter run
        pending: tuple[int, Metrics] | None = None

        def log(chunk: int, metrics: Metrics) -> None:
            row = self._row(chunk, metrics)
            writer.write(row)
            progress.update(row)
            self._warn_of_overflow(row)
            self._on_metrics(row)

        with Interrupt() as interrupt:
            while chunk < self.num_chunks and not interrupt.signal_name:
                state, metrics = self._chunk(state)
                if pending:  # fetched while the next chunk runs
                    log(*pending)
                chunk += 1
                pending = (chunk, metrics)
                if chunk % self.config.checkpoint.every_chunks == 0:
                    self._save(state, chunk)
                    saved_chunk = chunk
            if pending:
                log(*pending)
            if saved_chunk != chunk:
                self._save(state, chunk)
        progress.close()
        writer.close()
        plots.plot_run(self.folder.path)
        self._policies = [(self.algorithm.policy_params(state), {"env_steps": chunk * self.steps_per_chunk})]
        best = self._best_policy(state)
        if best:
            self._policies.append(best)
        if interrupt.signal_name:
            self._saver.wait()
        return interrupt.signal_name

    def score(self) -> None:
        """Score the last policy in the real Gymnasium, and write `eval_gymnasium.json`.

        Where an earlier one did better in the evaluations beside training, that one is scored too, and the better
        of the two is kept. Under a reward of one's own it is that earlier one alone.
        """
        num_episodes = self.config.evaluation.gymnasium_episodes
        if num_episodes:
            scored: list[tuple[Scores, Any, dict[str, Any]]] = []
            # By a reward of one's own another policy may be the best than by Gymnasium's, which does not choose then.
            candidates = self._policies[-1:] if self.task.has_own_reward else self._policies
            for params, facts in candidates:
                if not scored or facts["eval_return"] > scored[0][0].mean:
                    scored.append((self._score_in_gymnasium(params, num_episodes), params, facts))
            scores, params, facts = max(scored, key=lambda candidate: candidate[0].mean)
            scores.save(self.folder.gymnasium_scores, env_steps=facts["env_steps"], wall_seconds=self._seconds())
            print(f"In the real Gymnasium, {scores}", flush=True)
            self._saver.save((self.folder.best_policy, params, facts))
        self._saver.wait()

    def _score_in_gymnasium(self, policy_params: Any, num_episodes: int) -> Scores:
        return score_in_gymnasium(self.task, deterministic_act(self.algorithm, policy_params), num_episodes)

    def _start(self) -> tuple[TrainState, int]:
        """The TrainState to begin with, and the number of chunks behind it."""
        init = make_init(self.algorithm)
        key = jax.random.PRNGKey(self.config.seed)
        if not self.config.resume:
            return init(key), 0
        state, meta = checkpoint.restore_newest(self.folder.checkpoints, jax.eval_shape(init, key))
        self._seconds_before = meta["wall_seconds"]
        if self._best_policy(state):
            self._best_update = int(state.env.live.best_update)
        return state, meta["env_steps"] // self.steps_per_chunk

    def _row(self, chunk: int, metrics: Metrics) -> Row:
        row = name_metrics(jax.device_get(metrics), self.task.reward_terms, self.algorithm.steps_per_update)
        row["speed/steps_per_second"] = self._speed(chunk)
        return {"env_steps": chunk * self.steps_per_chunk, "wall_seconds": self._seconds(), **row}

    def _warn_of_overflow(self, row: Row) -> None:
        if row["physics/overflow"] and not self._has_warned:
            self._has_warned = True
            print(
                "warning: a Warp buffer overflowed, so that contacts were lost in some copies; the count is in the "
                "metrics as physics/overflow. Enlarge CONTACTS_PER_COPY or CONSTRAINTS_PER_COPY in "
                "envs/physics/mjx_warp.py",
                file=sys.stderr,
            )

    def _speed(self, chunk: int) -> float:
        """Steps per second over the last `_SPEED_WINDOW` seconds or so, evaluation and saving included."""
        now = time.monotonic()
        while len(self._times) > 1 and now - self._times[1][0] > _SPEED_WINDOW:
            self._times.popleft()
        then, chunk_then = self._times[0]
        self._times.append((now, chunk))
        return (chunk - chunk_then) * self.steps_per_chunk / max(now - then, 1e-9)

    def _seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started

    def _save(self, state: TrainState, chunk: int) -> None:
        """Begin to save the whole state; and the best policy, if it is a new one. Before the first evaluation is over,
        the best policy is the present one."""
        env_steps = chunk * self.steps_per_chunk
        facts = {"env_steps": env_steps, "wall_seconds": self._seconds()}
        parts = [(checkpoint.step_path(self.folder.checkpoints, env_steps), state, facts)]
        best = self._best_policy(state)
        if not best:
            parts.append((self.folder.best_policy, self.algorithm.policy_params(state), {"env_steps": env_steps}))
        elif int(state.env.live.best_update) != self._best_update:
            self._best_update = int(state.env.live.best_update)
            parts.append((self.folder.best_policy, *best))
        self._saver.save(*parts)

    def _best_policy(self, state: TrainState) -> tuple[Any, dict[str, Any]] | None:
        """The policy that did best in the evaluations beside training, and what is known of it."""
        live = state.env.live
        if math.isinf(live.best_return):
            return None
        env_steps = int(live.best_update) * self.algorithm.steps_per_update
        return live.best_policy_params, {"env_steps": env_steps, "eval_return": float(live.best_return)}
