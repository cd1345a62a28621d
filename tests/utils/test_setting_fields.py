"""Settings that have no effect under the values of others are refused where a user gives them."""

import dataclasses

import pytest

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.setting_fields import AnyBut, describe, has_effect, meanings, refuse_ineffective, setting, validate


@dataclasses.dataclass
class Algo:
    distribution: str = "squashed"
    state_dependent: bool = setting(False, only_if={"distribution": "normal"})
    noise: float = setting(1.0, only_if={"state_dependent": False})
    schedule: str = "constant"
    last_discount: float | None = None
    schedule_steps: int = setting(100, only_if={"schedule": AnyBut("constant"), "last_discount": AnyBut(None)})
    unused: int = setting(1, only_if={})


@dataclasses.dataclass
class Config:
    seed: int = 0
    algo: Algo = dataclasses.field(default_factory=Algo)


CASES = [
    (
        {"noise": 0.5},
        "algo.noise=0.5 has no effect with algo.distribution=squashed; change that, or leave it out",
    ),
    ({"distribution": "normal", "noise": 0.5}, None),
    (
        {"distribution": "normal", "state_dependent": True, "noise": 0.5},
        "algo.noise=0.5 has no effect with algo.state_dependent=true; change that, or leave it out",
    ),
    (
        {"schedule_steps": 7},
        "algo.schedule_steps=7 has no effect with algo.schedule=constant and algo.last_discount=null; "
        "change that, or leave it out",
    ),
    ({"schedule_steps": 7, "last_discount": 0.0}, None),
    ({"schedule_steps": 7, "schedule": "linear"}, None),
    ({"unused": 2}, "algo.unused=2 has no effect here; leave it out"),
]


@pytest.mark.parametrize(("values", "message"), CASES)
def test_a_given_setting_without_effect_is_refused(values, message):
    config = Config(algo=Algo(**values))
    keys = ["seed", "env", "algo", "algo.unknown", "nowhere.seed", *(f"algo.{name}" for name in values)]
    if message is None:
        refuse_ineffective(config, keys)
        return
    with pytest.raises(UserError) as error:
        refuse_ineffective(config, keys)
    assert str(error.value) == message


def test_settings_that_are_not_given_are_not_refused():
    refuse_ineffective(Config(algo=Algo(noise=0.5, unused=2)), ["seed"])
    assert not has_effect(Config(), "algo.noise") and has_effect(Config(), "algo.distribution")


def test_a_description_gives_default_range_and_condition():
    @dataclasses.dataclass
    class Ranges:
        rate: float = setting(0.1, above=0, at_most=1, only_if={"mode": AnyBut("off"), "steps": None})
        mode: str = setting("off", choices=("off", "on"))
        sizes: tuple[int, ...] = (32, 32)
        unused: int = setting(1, only_if={})

    assert [" ".join(line.split()) for line in describe(Ranges, "algo.")] == [
        "algo.rate=0.1 above 0 and at most 1; only with mode other than off or steps=null",
        "algo.mode=off off|on",
        "algo.sizes=[32,32]",
    ]


def test_a_meaning_is_the_docstring_below_a_field_or_that_of_the_base_class():
    @dataclasses.dataclass
    class Base:
        rate: float = 0.1
        """Step size
        of Adam."""
        steps: int = 1
        """Steps."""
        silent: int = 1

    @dataclasses.dataclass
    class Derived(Base):
        rate: float = 0.2
        steps: int = 2
        """Steps of all environments."""

    assert meanings(Derived) == {"rate": "Step size of Adam.", "steps": "Steps of all environments."}


@pytest.mark.parametrize("seed", [10**12 + 1, -(2**63), 10**4000])
def test_a_number_that_no_array_can_hold_is_refused(seed):
    with pytest.raises(UserError, match="must be at most 1000000000000"):
        validate(Config(seed=seed))
    validate(Config(seed=10**12))


def test_a_list_of_very_many_values_is_refused():
    """A network of as many layers would take hours to compile."""

    @dataclasses.dataclass
    class Network:
        sizes: tuple[int, ...] = setting((1,), at_least=1)

    validate(Network((1,) * 100))
    with pytest.raises(UserError, match="sizes has 101 values; give at most 100"):
        validate(Network((1,) * 101))
