"""A policy in PyTorch: `Policy("policy.safetensors")(obs)` is the action without noise, both in Gymnasium's units."""

import itertools
import json

import torch
from safetensors import safe_open
from torch import nn

__all__ = ["Policy"]


class Policy(nn.Module):
    """Observations `[…, observation_size]` → actions `[…, action_size] f32`."""

    mean: torch.Tensor
    std: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, path: str):
        super().__init__()
        with safe_open(path, "pt") as file:
            self.facts = json.loads(file.metadata()["network"])
            names = file.keys()
            arrays = {name: file.get_tensor(name) for name in names}
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(self.facts["sizes"]):
            norm = [nn.LayerNorm(outputs, eps=1e-6)] if self.facts["layer_norm"] else []
            layers += [nn.Linear(inputs, outputs), getattr(nn, self.facts["activation"])(), *norm]
        self.network = nn.Sequential(*layers[: -2 if self.facts["layer_norm"] else -1])
        for name in ("mean", "std", "low", "high"):
            self.register_buffer(name, torch.zeros_like(arrays[name]))
        self.load_state_dict(arrays)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        clip = self.facts["observation_clip"]
        action = self.network(((obs.float() - self.mean) / self.std).clip(-clip, clip))
        action = action.tanh() if self.facts["squashed"] else action.clip(-1, 1)
        return (self.low + self.high) / 2 + (self.high - self.low) / 2 * action
