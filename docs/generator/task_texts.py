"""Words of the task pages: starts, reward terms, terminations and the differences of v4.

The code has these as arithmetic. A test checks that every reward term of every version has its words here.
"""

from typing import NamedTuple

_CONTROL = "−`ctrl_cost_weight` × sum of the squared actions"
_FORWARD = "`forward_reward_weight` × velocity of the root along x, m/s"
_UNIFORM = "with uniform noise of ±`reset_noise_scale` on every position and velocity"
_NORMAL = (
    "with uniform noise of ±`reset_noise_scale` on every position, and normal noise of that standard deviation on "
    "every velocity"
)
_NO_TERMINATION = "Never. Episodes end at the time limit."
_BY_BODY = "The rows of each body are MuJoCo's `cinert`, `cvel` and `cfrc_ext`, in a frame at the center of mass."
_PAID_AT_THE_END = "v4 also pays `{term}` in the step that terminates the episode."
_ALWAYS_ZERO = (
    "v4 also observes the world body in `cinert`, `cvel` and `cfrc_ext`, and the root joint in `qfrc_actuator`. These "
    "numbers are always zero."
)


class TaskText(NamedTuple):
    """The words of one task's page."""

    goal: str
    start: str
    """Completes "Every episode starts …"."""
    rewards: dict[str, str]
    """Every reward term of every version, by its name in `info`."""
    termination: str
    observation: str = ""
    """Remarks on the observation."""
    v4: tuple[str, ...] = ()
    """Differences of v4 that the page cannot read from the code."""


TEXTS = {
    "humanoid": TaskText(
        goal="A humanoid runs forward on two legs.",
        start=f"standing, {_UNIFORM}",
        rewards={
            "reward_survive": "`healthy_reward` if the humanoid is healthy",
            "reward_forward": "`forward_reward_weight` × velocity of the center of mass along x, m/s",
            "reward_ctrl": _CONTROL,
            "reward_contact": "−`contact_cost_weight` × sum of the squared contact forces and torques on all bodies; "
            "the weighted cost is clipped to `contact_cost_range`",
            "reward_alive": "`healthy_reward`; without `terminate_when_unhealthy`, only if the humanoid is healthy",
            "reward_linvel": "`forward_reward_weight` × velocity of the center of mass along x, m/s",
            "reward_quadctrl": _CONTROL,
        },
        termination="When the humanoid is not healthy, unless `terminate_when_unhealthy=false`. It is healthy while "
        "the height of its root is inside `healthy_z_range`.",
        observation=_BY_BODY,
        v4=(
            _PAID_AT_THE_END.format(term="reward_alive"),
            "v4 has no contact cost.",
            _ALWAYS_ZERO,
        ),
    ),
    "humanoid_standup": TaskText(
        goal="A humanoid stands up from lying on its back, and stays up.",
        start=f"lying on the back, {_UNIFORM}",
        rewards={
            "reward_linup": "height of the root after the step in m, divided by the physics time step in s",
            "reward_quadctrl": _CONTROL,
            "reward_impact": "−`impact_cost_weight` × sum of the squared contact forces and torques on all bodies; "
            "the weighted cost is clipped to `impact_cost_range`",
        },
        termination=_NO_TERMINATION,
        observation=_BY_BODY,
        v4=(_ALWAYS_ZERO,),
    ),
    "walker2d": TaskText(
        goal="A two-legged walker runs forward in a plane.",
        start=f"standing, {_UNIFORM}",
        rewards={
            "reward_forward": _FORWARD,
            "reward_ctrl": _CONTROL,
            "reward_survive": "`healthy_reward` if the walker is healthy",
        },
        termination="When the walker is not healthy, unless `terminate_when_unhealthy=false`. It is healthy while the "
        "height of its root is inside `healthy_z_range` and the angle of its torso inside `healthy_angle_range`.",
        v4=(
            _PAID_AT_THE_END.format(term="reward_survive"),
            "The friction of the right foot is 0.9 in v4's model and 1.9 in v5's.",
        ),
    ),
    "ant": TaskText(
        goal="A four-legged ant runs forward.",
        start=f"standing, {_NORMAL}",
        rewards={
            "reward_forward": "`forward_reward_weight` × velocity of `main_body` along x, m/s",
            "reward_ctrl": _CONTROL,
            "reward_contact": "−`contact_cost_weight` × sum of the squared contact forces and torques on all bodies, "
            "each clipped to `contact_force_range`",
            "reward_survive": "`healthy_reward` if the ant is healthy",
        },
        termination="When the ant is not healthy, unless `terminate_when_unhealthy=false`. It is healthy while the "
        "height of its root is inside `healthy_z_range`.",
        observation="The rows of each body are MuJoCo's `cfrc_ext`, in a frame at the center of mass. They are clipped "
        "to `contact_force_range`.",
        v4=(
            _PAID_AT_THE_END.format(term="reward_survive"),
            "v4 neither observes contact forces nor has a contact cost, unless `use_contact_forces=true`. Then "
            "`reward_ctrl` is the contact cost, as in Gymnasium, and the control cost is `reward_quadctrl`.",
        ),
    ),
    "half_cheetah": TaskText(
        goal="A two-legged cheetah runs forward in a plane.",
        start=f"standing, {_NORMAL}",
        rewards={"reward_forward": _FORWARD, "reward_run": _FORWARD, "reward_ctrl": _CONTROL},
        termination=_NO_TERMINATION,
    ),
    "hopper": TaskText(
        goal="A one-legged hopper hops forward in a plane.",
        start=f"standing, {_UNIFORM}",
        rewards={
            "reward_forward": _FORWARD,
            "reward_ctrl": _CONTROL,
            "reward_survive": "`healthy_reward` if the hopper is healthy",
        },
        termination="When the hopper is not healthy, unless `terminate_when_unhealthy=false`. It is healthy while the "
        "height of its root is inside `healthy_z_range` and the angle of its torso inside `healthy_angle_range`. All "
        "angles and velocities must also be inside `healthy_state_range`.",
        v4=(_PAID_AT_THE_END.format(term="reward_survive"),),
    ),
    "swimmer": TaskText(
        goal="Three links swim forward in a plane of viscous fluid.",
        start=f"stretched, {_UNIFORM}",
        rewards={"reward_forward": _FORWARD, "reward_fwd": _FORWARD, "reward_ctrl": _CONTROL},
        termination=_NO_TERMINATION,
    ),
    "reacher": TaskText(
        goal="A two-joint arm in a plane moves its fingertip to a target.",
        start="with joint angles uniform in ±0.1 rad and joint velocities uniform in ±0.005 rad/s. The target is "
        "uniform in a disc with a radius of 0.2 m",
        rewards={
            "reward_dist": "−`reward_dist_weight` × distance from fingertip to target, m",
            "reward_ctrl": "−`reward_control_weight` × sum of the squared actions",
        },
        termination=_NO_TERMINATION,
        v4=(
            "v4 rewards the distance before the step, v5 the distance after it.",
            "v4 also observes z of the fingertip relative to the target.",
        ),
    ),
    "pusher": TaskText(
        goal="A seven-joint arm pushes a cylinder to a goal.",
        start="with joint velocities uniform in ±0.005 rad/s. The object is uniform in a rectangle of 0.3 m × 0.4 m, "
        "at least 0.17 m from the goal",
        rewards={
            "reward_dist": "−`reward_dist_weight` × distance from object to goal, m",
            "reward_ctrl": "−`reward_control_weight` × sum of the squared actions",
            "reward_near": "−`reward_near_weight` × distance from fingertip to object, m",
        },
        termination=_NO_TERMINATION,
    ),
    "inverted_pendulum": TaskText(
        goal="A cart balances a pole.",
        start=f"upright, {_UNIFORM}",
        rewards={"reward_survive": "1 if the pole's angle is at most 0.2 rad"},
        termination="When the pole's angle exceeds 0.2 rad.",
        v4=(_PAID_AT_THE_END.format(term="reward_survive"),),
    ),
    "inverted_double_pendulum": TaskText(
        goal="A cart balances two poles, one on the other.",
        start=f"upright, {_NORMAL}",
        rewards={
            "reward_survive": "`healthy_reward` if the tip is above 1 m",
            "distance_penalty": "−(0.01 x² + (z − 2)²) with the tip's position x and z, m",
            "velocity_penalty": "−(0.001 ω₁² + 0.005 ω₂²) with the angular velocities of the poles, rad/s",
        },
        termination="When the tip is at a height of 1 m or less.",
        observation="The constraint force is clipped to ±10.",
        v4=(
            _PAID_AT_THE_END.format(term="reward_survive"),
            "v4 observes the constraint forces of all three joints, v5 only the cart's.",
        ),
    ),
}
