"""What the two MJX engines share: the model they take, and the arrays they hand back."""

import copy

import mujoco
from mujoco import mjx

from mjx_walk.envs.physics.base import Derived

MIN_SOLVER_ITERATIONS = 8
"""Newton's iterations and line-search steps. In float32, 4 are exact only while few contacts act; 8 equal 50."""


def with_newton_solver(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of `model` solved by Newton's method, converged.

    Deviation: Gymnasium's humanoids use PGS, which MJX does not have. The constraint problem is convex and has one
    solution; converged, the two solvers agree to 1e-6.
    """
    model = copy.deepcopy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations = MIN_SOLVER_ITERATIONS
    model.opt.ls_iterations = MIN_SOLVER_ITERATIONS
    return model


def read_derived(data: mjx.Data, names: tuple[str, ...]) -> Derived:
    """The named arrays; MJX keeps some of them in the part of its data that belongs to the implementation."""
    return {name: getattr(data, name) if hasattr(data, name) else getattr(data._impl, name) for name in names}
