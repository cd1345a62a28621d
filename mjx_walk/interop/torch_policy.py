"""Export of a policy to PyTorch: its arrays as safetensors, and a module that loads them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.networks import ACTIVATION
from safetensors.numpy import save

from mjx_walk.algos.off_policy_config import OffPolicyConfig
from mjx_walk.algos.on_policy_config import OnPolicyConfig
from mjx_walk.evaluation.saved_policies import SavedPolicy
from mjx_walk.storage.files import replacing
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.types import Params, PyTree

__all__ = ["MODULE", "WEIGHTS", "write_policy"]

WEIGHTS, MODULE = "policy.safetensors", "policy.py"
"""Files of a folder that `write_policy` fills."""
_ACTIVATIONS = {
    "celu": "CELU",
    "elu": "ELU",
    "leaky_relu": "LeakyReLU",
    "log_sigmoid": "LogSigmoid",
    "relu": "ReLU",
    "relu6": "ReLU6",
    "selu": "SELU",
    "sigmoid": "Sigmoid",
    "silu": "SiLU",
    "soft_sign": "Softsign",
    "softplus": "Softplus",
    "swish": "SiLU",
    "tanh": "Tanh",
}
"""Brax's activations that PyTorch has, with PyTorch's names."""
_TOLERANCE = 1e-4
"""Largest difference of an action, as a share of its range, between the exported arrays and the policy."""


class _Facts(TypedDict):
    """What builds the network around the arrays, stored as JSON."""

    sizes: list[int]
    """Sizes of the observation, the hidden layers and the action."""
    activation: str
    """PyTorch's name."""
    layer_norm: bool
    squashed: bool
    """Whether tanh bounds the action. Otherwise it is clipped."""
    observation_clip: float


def write_policy(folder: Path, run: SavedPolicy, metadata: Mapping[str, str]) -> None:
    """Write the files of a policy into an existing folder.

    Raises:
        UserError: PyTorch has no such network.
    """
    arrays, facts = _arrays(run), _facts(run)
    _check(run, arrays, facts)
    module = Path(__file__).with_name("torch_loader.py")
    with replacing(folder / WEIGHTS) as new:
        new.write_bytes(save(arrays, {**metadata, "network": json.dumps(facts)}))
    with replacing(folder / MODULE) as new:
        new.write_bytes(module.read_bytes())


def _facts(run: SavedPolicy) -> _Facts:
    algo: Any = run.config.algo
    if algo.activation not in _ACTIVATIONS:
        raise UserError(f"PyTorch has no activation '{algo.activation}' of this policy; use format=onnx")
    return {
        "sizes": [run.task.observation_size, *algo.policy_hidden_layer_sizes, run.task.action_size],
        "activation": _ACTIVATIONS[algo.activation],
        "layer_norm": isinstance(algo, OffPolicyConfig) and algo.policy_layer_norm,
        "squashed": not (isinstance(algo, OnPolicyConfig) and algo.distribution == "normal"),
        "observation_clip": algo.observation_clip or float(np.finfo(np.float32).max),
    }


def _arrays(run: SavedPolicy) -> dict[str, np.ndarray]:
    """Arrays under the names of the module's state, `f32`."""
    normalizer, variables = jax.device_get(run.policy_params)
    params = variables["params"]
    found = {
        "mean": normalizer.mean,
        "std": normalizer.std,
        "low": run.task.action_low,
        "high": run.task.action_high,
    }
    hidden = params.get("MLP_0", params)
    layers, norms = _numbered(hidden, "hidden_"), _numbered(hidden, "LayerNorm_")
    layers += [params["Dense_0"]] if "Dense_0" in params else []
    place = 0
    for i, layer in enumerate(layers):
        # The last layer of a squashed Gaussian also gives its std.
        kept = slice(run.task.action_size if i == len(layers) - 1 else None)
        found[f"network.{place}.weight"], found[f"network.{place}.bias"] = layer["kernel"].T[kept], layer["bias"][kept]
        place += 2  # an activation follows
        if i < len(norms):
            found[f"network.{place}.weight"], found[f"network.{place}.bias"] = norms[i]["scale"], norms[i]["bias"]
            place += 1
    return {name: np.ascontiguousarray(array, np.float32) for name, array in found.items()}


def _numbered(params: Params, prefix: str) -> list[PyTree]:
    """Parameters whose names are a prefix and a number, in order."""
    numbers = sorted(int(name.removeprefix(prefix)) for name in params if name.startswith(prefix))
    return [params[f"{prefix}{number}"] for number in numbers]


def _check(run: SavedPolicy, arrays: Mapping[str, np.ndarray], facts: _Facts) -> None:
    """Compare the arrays with the policy on random observations.

    Raises:
        UserError: the actions differ.
    """
    mean, std, low, high = (arrays[name] for name in ("mean", "std", "low", "high"))
    obs = mean + 2 * std * np.random.default_rng(0).normal(size=(64, mean.size)).astype(np.float32)
    values = np.clip((obs - mean) / std, -facts["observation_clip"], facts["observation_clip"])
    activation = ACTIVATION[run.config.algo.activation]
    places = sorted({int(name.split(".")[1]) for name in arrays if name.startswith("network.")})
    for place in places:
        weight, bias = arrays[f"network.{place}.weight"], arrays[f"network.{place}.bias"]
        if weight.ndim == 1:
            deviation = values - values.mean(-1, keepdims=True)
            values = deviation / np.sqrt((deviation**2).mean(-1, keepdims=True) + 1e-6) * weight + bias
            continue
        values = values @ weight.T + bias
        values = values if place == places[-1] else np.asarray(activation(jnp.asarray(values)))
    action = np.tanh(values) if facts["squashed"] else np.clip(values, -1, 1)
    difference = (low + high) / 2 + (high - low) / 2 * action - run.policy(obs)
    if not (np.abs(difference) <= _TOLERANCE * (high - low)).all():
        raise UserError("PyTorch's layers do not give this policy's actions; use format=onnx")
