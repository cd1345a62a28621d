"""The only host loop: run a chunk on the device, log it, evaluate, save."""

import collections
import signal
import sys
import time
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_walk.algos import make_algorithm
from mjx_walk.envs import Task
from mjx_walk.runs.checkpoint import list_steps
from mjx_walk.runs.config import Config
from mjx_walk.runs.loggers import Progress
from mjx_walk.runs.metrics import Row, name_metrics, physics_warnings
from mjx_walk.runs.run_folder import RunFolder
from mjx_walk.training.distributed import Team, per_device
from mjx_walk.training.recorder import Follower, Recorder
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.signals import Interrupt
from mjx_walk.utils.types import Algorithm, Metrics, TrainState

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


def over_seeds(algorithm: Algorithm) -> Algorithm:
    """The same for several runs side by side: keys, TrainStates, batches and metrics have an axis in front."""
    return algorithm._replace(
        init=jax.vmap(algorithm.init), collect=jax.vmap(algorithm.collect), learn=jax.vmap(algorithm.learn)
    )


class Trainer:
    """From configurations to scores: of one run, or of several that differ in their seed alone, in one program."""

    def __init__(
        self,
        configs: list[Config],
        task: Task,
        folders: list[RunFolder],
        on_metrics: Callable[[Row], None] | None = None,
        team: Team | None = None,
    ):
        """
        Args:
            configs: checked configurations, alike but for `seed` and `run_dir`.
            task: the unbatched environment.
            folders: prepared run folders, one for each.
            on_metrics: called with every row that is logged.
            team: the processes that train a run together, each with `num_envs` copies.
        """
        self.config = config = configs[0]
        self._task = task
        self._folders = folders
        self._team = team
        settings = per_device(config.algo, team.size) if team else config.algo
        alone = make_algorithm(task, config.num_envs, config.evaluation, settings)
        self._steps_per_iteration = alone.steps_per_iteration * (team.size if team else 1)
        make_recorder = Follower if team and team.rank else Recorder
        self.recorders = [
            make_recorder(own, task, alone, folder, team) for own, folder in zip(configs, folders, strict=True)
        ]
        self.steps_per_call = self._steps_per_iteration * config.iterations_per_call
        self.num_chunks = -(-config.total_steps // self.steps_per_call)
        if team:
            self.algorithm = team.beginning(alone)
            self._chunk = team.make_chunk(alone, config.iterations_per_call, task.reward_terms)
        else:
            self.algorithm = over_seeds(alone) if len(configs) > 1 else alone
            self._chunk = make_chunk(self.algorithm, config.iterations_per_call, fused=not task.engine.calls_host)
        self._has_axis = team is not None or len(configs) > 1  # in front of every array
        self._are_finite = jax.jit(jax.vmap(self._has_finite_policy) if self._has_axis else self._has_finite_policy)
        self._on_metrics = on_metrics or (lambda row: None)
        self._started = time.monotonic()
        self._times: collections.deque[tuple[float, int]] = collections.deque()
        self._seconds_before = 0.0
        self._warned_of: set[str] = set()

    def train(self) -> str | None:
        """Train to the end, or until a signal asks to stop.

        Returns:
            None at the end, else the name of the signal; the states are saved either way.

        Raises:
            UserError: a policy is not finite any more.
        """
        state, chunk = self._start()
        progress = Progress(self.num_chunks * self.steps_per_call, chunk * self.steps_per_call)
        saved_chunk = chunk or -1
        self._times.append((time.monotonic(), chunk))
        for recorder in self.recorders:
            recorder.begin(chunk * self.steps_per_call, trains_on=chunk < self.num_chunks)
        diverged: set[int] = set()
        with Interrupt() as interrupt:
            while chunk < self.num_chunks and not self._stop_signal(interrupt) and not diverged:
                state, metrics = self._chunk(state)
                chunk += 1
                rows = self._rows(chunk, metrics)  # waits for the chunk, so that its row tells the time of its end
                self._log(state, rows, progress)
                diverged = {
                    r.config.seed for r, ok in zip(self.recorders, self._finiteness(state), strict=True) if not ok
                }
                if chunk % self.config.checkpoint.every_calls == 0:
                    self._save(state, chunk)
                    saved_chunk = chunk
            signal_name = self._stop_signal(interrupt)
            if saved_chunk != chunk:
                self._save(state, chunk)
        progress.close()
        if hasattr(state, "replay"):
            state = state.replace(replay=())  # saved, and not looked at again
        for recorder, own in zip(self.recorders, self._split(state), strict=True):
            recorder.end(own, chunk * self.steps_per_call)
            if signal_name or diverged:
                recorder.wait()
        if diverged:
            raise UserError(
                f"training has diverged: after {chunk * self.steps_per_call:,} steps the policy of seed "
                f"{', '.join(map(str, sorted(diverged)))} is not finite any more; checkpoints from before are kept; "
                "lower the learning rate, or clip gradients"
            )
        return signal_name

    def score(self) -> None:
        """Score every run in the real Gymnasium; see `Recorder.score`. However it ends, all is on the disk then."""
        seconds = self._seconds()  # the same for all, whichever is scored first
        try:
            for recorder in self.recorders:
                scores = recorder.score(seconds)
                which = f"seed {recorder.config.seed}: " if len(self.recorders) > 1 else ""
                if scores:
                    print(f"{which}In the real Gymnasium, {scores}", flush=True)
        finally:  # also where Ctrl-C ends it
            for recorder in self.recorders:
                recorder.wait()

    def _start(self) -> tuple[TrainState, int]:
        """The TrainState to begin with, and the number of chunks behind it."""
        keys = [jax.random.PRNGKey(recorder.config.seed) for recorder in self.recorders]
        init = make_init(self.algorithm)
        key = keys[0] if len(keys) == 1 else jnp.stack(keys)
        if not self.config.resume or not any(list_steps(folder.checkpoints) for folder in self._folders):
            for folder in self._folders:
                if self.config.resume and folder.metrics.exists():  # of a run that was stopped before it had saved
                    warnings.warn(f"{folder.path} holds no checkpoint; it begins again", stacklevel=2)
            return init(key), 0
        like = jax.eval_shape(init, key)
        if self._has_axis:
            like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), like)
        states, facts = [], []
        for recorder in self.recorders:
            state, fact = recorder.restore(like)
            facts.append(fact)
            # Through the host, where there is room for all of them twice.
            states.append(jax.device_get(state) if self._has_axis else state)
        steps = {fact["env_steps"] for fact in facts}
        if len(steps) > 1:
            at = ", ".join(f"{step:,}" for step in sorted(steps))
            raise UserError(f"the seeds stand at different steps ({at}); resume each alone")
        self._seconds_before = max(fact["wall_seconds"] for fact in facts)
        state = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *states) if self._has_axis else states[0]
        return state, steps.pop() // self.steps_per_call

    def _split(self, state: TrainState) -> list[TrainState]:
        """The TrainState of each run, without an axis in front; if there was one, on the host, where there is room."""
        if not self._has_axis:
            return [state]
        state = jax.device_get(state)
        return [jax.tree.map(lambda x, i=i: x[i], state) for i in range(len(self.recorders))]

    def _rows(self, chunk: int, metrics: Metrics) -> list[Row]:
        metrics = jax.device_get(metrics)
        common = {"env_steps": chunk * self.steps_per_call, "wall_seconds": self._seconds()}
        speed = {
            "speed/steps_per_second": self._speed(chunk),
            "speed/seeds_together": float(len(self.recorders)),
        }
        rows = []
        for i in range(len(self.recorders)):
            own = metrics if len(self.recorders) == 1 else {name: value[:, i] for name, value in metrics.items()}
            rows.append(common | name_metrics(own, self._task.reward_terms, self._steps_per_iteration) | speed)
        return rows

    def _log(self, state: TrainState, rows: list[Row], progress: Progress) -> None:
        """Write and show the rows of the chunk that ended with a TrainState."""
        for recorder, row in zip(self.recorders, rows, strict=True):
            recorder.write(row)
            self._warn_of_physics(row)
            self._on_metrics(row)
        self._film(state, rows)
        if not self._team or self._team.rank == 0:
            progress.update(_mean_row(rows))

    def _film(self, state: TrainState, rows: list[Row]) -> None:
        """Film the policies of those runs whose round of evaluation has ended."""
        policies = self.algorithm.policy_params(state)
        for i, (recorder, row) in enumerate(zip(self.recorders, rows, strict=True)):
            if "eval/return" in row:
                own = jax.tree.map(lambda x, i=i: x[i], policies) if self._has_axis else policies
                recorder.film(own, int(row["env_steps"]))

    def _warn_of_physics(self, row: Row) -> None:
        for metric, warning in physics_warnings(row, self.steps_per_call).items():
            if metric not in self._warned_of:
                self._warned_of.add(metric)
                print(f"warning: {warning}; the count is in the metrics as {metric}", file=sys.stderr)

    def _speed(self, chunk: int) -> float:
        """Steps per second of each run over the last `_SPEED_WINDOW` seconds or so, evaluation and saving included."""
        now = time.monotonic()
        while len(self._times) > 1 and now - self._times[1][0] > _SPEED_WINDOW:
            self._times.popleft()
        then, chunk_then = self._times[0]
        self._times.append((now, chunk))
        return (chunk - chunk_then) * self.steps_per_call / max(now - then, 1e-9)

    def _seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started

    def _save(self, state: TrainState, chunk: int) -> None:
        """Save the TrainState of every run whose policy is finite."""
        for recorder, own, is_finite in zip(self.recorders, self._split(state), self._finiteness(state), strict=True):
            if is_finite:
                recorder.save(own, chunk * self.steps_per_call, self._seconds())

    def _stop_signal(self, interrupt: Interrupt) -> str | None:
        """The name of the signal that asks to stop, whichever of the processes it has reached."""
        if not self._team:
            return interrupt.signal_name
        number = signal.Signals[interrupt.signal_name].value if interrupt.signal_name else 0
        number = max(self._team.gather(number))
        return signal.Signals(number).name if number else None

    def _finiteness(self, state: TrainState) -> np.ndarray:
        """Whether each run's policy is finite, as an array of bool."""
        return np.atleast_1d(self._are_finite(state))

    def _has_finite_policy(self, state: TrainState) -> jax.Array:
        leaves = jax.tree.leaves(self.algorithm.policy_params(state))
        return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]))


def _mean_row(rows: list[Row]) -> Row:
    """Means over the runs that have a value, to be shown."""
    values = {name: [row[name] for row in rows if name in row] for name in {name for row in rows for name in row}}
    return {name: sum(found) / len(found) for name, found in values.items()}
