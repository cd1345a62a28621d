"""Policies between the untrained and the best one of a training.

How good the best one will be is only known at the end. So snapshots are kept during training, and evaluated at its end.
"""

import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from mjx_walk.storage import checkpoint
from mjx_walk.storage.arrays import HostArrays
from mjx_walk.storage.checkpoint_metadata import Metadata
from mjx_walk.storage.scores import MILESTONES
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import PolicyParams

__all__ = ["KeptPolicies", "Snapshots", "find_milestones", "milestone_line"]

KeptPolicies = dict[str, tuple[PolicyParams, Metadata]]
"""Policies and their metadata, by name."""

_MOST = 32
"""Snapshots of a run. The last gaps between them are about 6% of its steps, and the first ones are single calls."""
_NEAR = 0.1
"""Distance from a fraction that ends the search."""
_FAR = 1 / 6
"""Half of the distance between two milestones, from which on a policy is nearer to another one."""


class Snapshots:
    """Policies of a training, from its start to its present step.

    Checkpoints hold them, and only the steps decide which ones are kept. So a resumed run keeps the same.
    """

    def __init__(self) -> None:
        self.policies: list[PolicyParams] = []
        """On the host."""
        self.env_steps: list[int] = []
        """Environment steps before each of them, rising."""

    @classmethod
    def restore(cls, path: Path, metadata: Metadata, like: PolicyParams) -> "Snapshots | None":
        """The snapshots that a checkpoint holds. None if it has none or if they are damaged, with a warning.

        Args:
            path: folder of the checkpoint.
            metadata: its metadata.
            like: policy of shapes and dtypes.

        Raises:
            UserError: they cannot be read now.
        """
        found = cls()
        found.env_steps = metadata.get("snapshots", []).copy()
        count = len(found.env_steps)
        stacked = jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), like)
        try:
            if not count:
                raise ValueError(f"{path} holds no snapshots")
            tree, _ = checkpoint.restore(path, {checkpoint.SNAPSHOTS: stacked})
        except UserError:
            raise
        except ValueError as error:
            warnings.warn(f"{error}; the run keeps no milestones", stacklevel=2)
            return None
        restored = jax.device_get(tree[checkpoint.SNAPSHOTS])
        found.policies = [jax.tree.map(lambda x, i=i: x[i], restored) for i in range(count)]
        return found

    def take(self, policy_params: PolicyParams, env_steps: int) -> None:
        """Copy the present policy to the host.

        If there are too many, one is dropped, so that their distances rise with the square root of the steps: most
        trainings learn most at the beginning.
        """
        if self.env_steps and env_steps <= self.env_steps[-1]:
            return  # the run has just resumed from here
        self.policies.append(jax.tree.map(np.array, jax.device_get(policy_params)))  # device memory is reused
        self.env_steps.append(env_steps)
        if len(self.env_steps) > _MOST:
            roots = np.sqrt(self.env_steps)
            index = 1 + int(np.argmin(roots[2:] - roots[:-2]))
            del self.policies[index], self.env_steps[index]

    def arrays(self) -> HostArrays:
        """What a checkpoint holds besides the TrainState, stacked over the snapshots."""
        if not self.policies:
            return {}
        return checkpoint.to_host({checkpoint.SNAPSHOTS: jax.tree.map(lambda *xs: np.stack(xs), *self.policies)})


def find_milestones(snapshots: Snapshots, best: Metadata, mean_return: Callable[[PolicyParams], float]) -> KeptPolicies:
    """The policies near the fractions of `MILESTONES` between the first and the best return, by name.

    Args:
        snapshots: of the complete training.
        best: metadata of its best policy.
        mean_return: evaluates a policy.

    Returns:
        The policies, with their `fraction`. None if there are no snapshots, or the best return is not above the first.
    """
    count = int(np.searchsorted(snapshots.env_steps, best["env_steps"]))
    if not count:
        return {}
    curve = _Curve(snapshots.policies, mean_return, best["eval_return"])
    if curve.first_return >= best["eval_return"]:
        return {}
    for wanted in MILESTONES.values():
        curve.search(wanted, count)
    found: KeptPolicies = {}
    for name, wanted in MILESTONES.items():
        index = curve.nearest(wanted)
        found[name] = (
            snapshots.policies[index],
            {
                "env_steps": snapshots.env_steps[index],
                "eval_return": curve.returns[index],
                "fraction": curve.fraction(index),
            },
        )
    return found


class _Curve:
    """Returns of policies along a training. An evaluation takes as long as that of the final policy."""

    def __init__(self, policies: list[PolicyParams], mean_return: Callable[[PolicyParams], float], best_return: float):
        """
        Args:
            policies: in the order of their steps.
            mean_return: evaluates a policy.
            best_return: return of the best one.
        """
        self._policies = policies
        self._mean_return = mean_return
        self._best_return = best_return
        self.first_return = mean_return(policies[0])
        self.returns = {0: self.first_return}
        """Of those that have been evaluated, by index."""

    def fraction(self, index: int) -> float:
        """Part of the way from the first return to the best one at which a policy is. Evaluates it if necessary."""
        if index not in self.returns:
            self.returns[index] = self._mean_return(self._policies[index])
        return (self.returns[index] - self.first_return) / (self._best_return - self.first_return)

    def nearest(self, wanted: float) -> int:
        """Index of the evaluated policy that is nearest to a fraction."""
        indices = list(self.returns)
        return indices[int(np.argmin([abs(self.fraction(index) - wanted) for index in indices]))]

    def search(self, wanted: float, last: int) -> None:
        """Evaluate policies until one is near a fraction: by bisection, then the others around its result.

        Args:
            wanted: the fraction.
            last: index above which the best policy follows. Bisection needs one that is high enough.
        """
        below, above = 0, last
        while above - below > 1:
            middle = (below + above) // 2
            below, above = (middle, above) if self.fraction(middle) < wanted else (below, middle)
        indices = np.arange(len(self._policies))
        for index in indices[np.argsort(abs(indices - above), kind="stable")]:
            if abs(self.fraction(self.nearest(wanted)) - wanted) <= _NEAR:
                return
            self.fraction(int(index))


def milestone_line(kept: KeptPolicies) -> str:
    """Which milestones a training has kept, how far each is, and which ones are far from where they should be."""
    milestones = {name: kept[name][1] for name in MILESTONES if name in kept}
    if not milestones:
        return "No milestones are kept: the best policy is not better than the first one"
    places = (
        f"{name} (step {metadata['env_steps']:,}) at {metadata['fraction']:.0%} of the way"
        for name, metadata in milestones.items()
    )
    line = f"Milestones from the first to the best evaluation: {', '.join(places)}"
    far = [name for name, metadata in milestones.items() if abs(metadata["fraction"] - MILESTONES[name]) > _FAR]
    wanted = " and ".join(f"{MILESTONES[name]:.0%}" for name in far)
    return f"{line}. No snapshot was found nearer to {wanted}; a lower iterations_per_call keeps more" if far else line
