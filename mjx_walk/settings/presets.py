"""Presets: one override that stands for several settings."""

from mjx_walk.envs.randomization.options import changes, preset

__all__ = ["with_presets"]

_KEY = "env.randomize"


def with_presets(overrides: list[str]) -> list[str]:
    """Overrides with `env.randomize=NAME` replaced by the settings of that preset. Later overrides change them.

    Raises:
        UserError: an unknown preset.
    """
    expanded = []
    for override in overrides:
        key, _, name = override.partition("=")
        if key != _KEY:
            expanded.append(override)
            continue
        for setting, value in changes(preset(name)).items():
            text = f"[{value[0]},{value[1]}]" if isinstance(value, tuple) else str(value)
            expanded.append(f"{_KEY}.{setting}={text}")
    return expanded
