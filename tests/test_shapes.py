"""The run-time check of shapes finds a wrong argument and a wrong signature."""

import importlib.util

import jax.numpy as jnp
import jaxtyping
import pytest
from shapes import CheckedLoader

from mjx_walk.common import returns

REWARD, ENDED = jnp.ones((3, 2)), jnp.zeros((3, 2), bool)


def load(path, text):
    """The module of a file with this text, checked."""
    path.write_text(text)
    loader = CheckedLoader(path.stem, str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(path.stem, loader))
    loader.exec_module(module)
    return module


def test_an_argument_of_another_shape_or_dtype_is_refused(tmp_path):
    with open(returns.__file__, encoding="utf-8") as file:
        checked = load(tmp_path / "checked.py", file.read())
    checked.n_step_return(REWARD, ENDED, 0.9)
    for reward, ended in ((REWARD[0], ENDED), (REWARD[:2], ENDED), (REWARD, jnp.float32(ENDED))):
        with pytest.raises(jaxtyping.TypeCheckError, match="n_step_return"):
            checked.n_step_return(reward, ended, 0.9)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [('tuple[Float[Array, " N"]', 'tuple[Float[Array, " n"]'), ('Int32[Array, " N"]', "Int32[Array, '']")],
)
def test_a_wrong_shape_in_a_signature_is_found(tmp_path, right, wrong):
    with open(returns.__file__, encoding="utf-8") as file:
        text = file.read()
    assert text.count(right) == 1
    load(tmp_path / "right.py", text).n_step_return(REWARD, ENDED, 0.9)
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        load(tmp_path / "wrong.py", text.replace(right, wrong)).n_step_return(REWARD, ENDED, 0.9)
