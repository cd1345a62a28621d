"""View of a task in films, pages and gait sheets."""

from typing import NamedTuple

__all__ = ["View"]


class View(NamedTuple):
    """Body and camera that films, pages and gait sheets of a task use."""

    body: int = 1
    """Body whose height and speed they show. In Gymnasium's models, body 1 is the root, and the world is body 0."""
    center: tuple[float, float, float] | None = None
    """Point that the camera looks at, m. Default: the camera follows the body."""
    distance: float = 4.0
    """From the camera to its center, m."""
    elevation: float = -8.0
    """Angle of the line of sight above the horizon, degrees; -90 looks straight down."""
    azimuth: float = 90.0
    """Direction of the line of sight, degrees; 0 looks along x, 90 along y."""
