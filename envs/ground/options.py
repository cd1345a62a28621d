"""Options of the ground, and their presets."""

import dataclasses

from mjx_walk.utils.setting_fields import AnyBut, setting

__all__ = ["PRESETS", "Ground"]

_NOT_FLAT = {"slope": AnyBut(0.0), "step_height": AnyBut(0.0), "roughness": AnyBut(0.0)}


@dataclasses.dataclass
class Ground:
    """Hills across the way, each kind harder from one to the next. The defaults are the model's own, flat floor."""

    slope: float = setting(0.0, at_least=0, at_most=45)
    """Slope of the last ramps, degrees. 0: no ramps."""
    step_height: float = setting(0.0, at_least=0, at_most=0.25)
    """Height of the last steps, m. A step is 0.4 m deep. 0: no steps."""
    roughness: float = setting(0.0, at_least=0, at_most=0.25)
    """Largest height of the last bars, m. A bar is 0.4 m deep. 0: no bars."""
    rows: int = setting(10, at_least=1, at_most=32, only_if=_NOT_FLAT)
    """Hills along x, one every 9 m. Ramps, steps and bars take turns."""
    first_rows: int = setting(5, at_least=1, at_most=32, only_if=_NOT_FLAT)
    """An episode starts before one of so many hills. With fewer hills, it starts before any of them."""


PRESETS = {
    "slopes": Ground(slope=15.0),
    "steps": Ground(step_height=0.1),
    "rough": Ground(roughness=0.1),
    "mixed": Ground(slope=15.0, step_height=0.1, roughness=0.1),
}
"""Values of `env.ground` for several settings at once."""
