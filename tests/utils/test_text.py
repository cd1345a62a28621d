"""Text of strangers, as it is shown."""

import pytest

from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import in_markdown, printable


def test_a_message_is_one_line_without_controls_and_not_too_long():
    assert printable("a\x1b[2J\nb\u202ec\udcff é") == r"a\x1b[2J\nb\u202ec\udcff é"
    assert str(UserError("no file 'a\n'")) == r"no file 'a\n'"
    long = printable("start " + "x" * 100_000 + " end")
    assert long.startswith("start x") and long.endswith("x end") and len(long) < 2100


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a|b", r"a\|b"),
        ("a\\|b", r"a\\\|b"),
        ("<img src=x>", r"\<img src=x\>"),
        ("![x](http://y)", r"![x\](http://y)"),
        ("`a` $b$", r"\`a\` \$b\$"),
        ("ppo, policy_hidden_layer_sizes=[256, 256]", "ppo, policy_hidden_layer_sizes=[256, 256]"),
    ],
)
def test_text_cannot_become_markup(text, shown):
    assert in_markdown(text) == shown
