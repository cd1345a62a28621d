"""Settings under former names, on command lines and in saved configurations."""

import warnings

from omegaconf import DictConfig, OmegaConf

__all__ = ["present_key", "present_overrides", "under_present_names"]

_RENAMED = {
    "updates_per_chunk": "iterations_per_call",
    "checkpoint.every_chunks": "checkpoint.every_calls",
    "checkpoint.keep": "checkpoint.max_to_keep",
    "algo.updates_per_step": "algo.grad_updates_per_step",
    "algo.prefill_steps": "algo.learning_starts",
    "algo.measured_steps": "algo.normalizer_warmup_steps_per_env",
    "algo.return_bound": "algo.normalized_return_max",
    "algo.stagger_episodes": "algo.init_at_random_episode_step",
    "algo.max_unseen": "algo.max_tail_discount",
    "algo.value_cost": "algo.value_loss_coef",
    "algo.entropy_cost": "algo.entropy_coef",
    "algo.mean_bound_cost": "algo.mean_bound_coef",
}
"""Present names of settings by their former names. Saved configurations load silently; command lines warn."""


def present_key(key: str) -> str:
    """The present name of a setting."""
    return _RENAMED.get(key, key)


def present_overrides(overrides: list[str]) -> list[str]:
    """Overrides under the present names of their settings. A former name warns."""
    present = []
    for override in overrides:
        key, equals, value = override.partition("=")
        if key in _RENAMED:
            warnings.warn(f"{key} is now {_RENAMED[key]}; the former name still works", stacklevel=2)
        present.append(present_key(key) + equals + value)
    return present


def under_present_names(saved: DictConfig) -> DictConfig:
    """Move the renamed settings of a saved configuration to their present names."""
    for old, new in _RENAMED.items():
        section, _, name = old.rpartition(".")
        node = OmegaConf.select(saved, section) if section else saved
        if node is not None and name in node:
            node[new.rpartition(".")[2]] = node.pop(name)
    return saved
