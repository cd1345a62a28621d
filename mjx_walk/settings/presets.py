"""Presets: one override that stands for several settings."""

from mjx_walk.envs.option_presets import changes, preset
from mjx_walk.envs.task_options import OPTION_PRESETS

__all__ = ["with_presets"]


def with_presets(overrides: list[str]) -> list[str]:
    """Overrides with `env.GROUP=NAME` replaced by the settings of that preset.

    A preset replaces all earlier settings of its group, and later ones change its settings.

    Raises:
        UserError: an unknown preset.
    """
    expanded: list[str] = []
    for override in overrides:
        key, _, name = override.partition("=")
        presets = OPTION_PRESETS.get(key.removeprefix("env.")) if key.startswith("env.") else None
        if presets is None or name.startswith("{"):
            expanded.append(override)
            continue
        expanded = [former for former in expanded if not former.startswith(f"{key}.")]
        for setting, value in changes(preset(key, name, presets)).items():
            text = f"[{value[0]},{value[1]}]" if isinstance(value, tuple) else str(value)
            expanded.append(f"{key}.{setting}={text}")
    return expanded
