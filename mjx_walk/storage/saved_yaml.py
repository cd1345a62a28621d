"""Reads the YAML of a saved configuration, which may come from a stranger."""

from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from mjx_walk.storage.files import read_bytes
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.text import has_controls

__all__ = ["MAX_BYTES", "read_yaml"]

MAX_BYTES = 100_000
"""About thirty times the largest configuration of this package."""
_REFUSED = {
    yaml.AliasToken: "an alias",  # ten aliases of ten aliases of … take all memory
    yaml.AnchorToken: "an anchor",
    yaml.TagToken: "a tag",
}


def read_yaml(path: Path) -> DictConfig:
    """Read a file that holds nothing but keys and plain values.

    Raises:
        UserError: it is too large, or has interpolations, aliases, tags or characters that cannot be printed.
        UnicodeDecodeError, yaml.YAMLError, RecursionError: it is not YAML in UTF-8.
        OSError: it is not a regular file, or cannot be read.
    """
    try:
        content = read_bytes(path, MAX_BYTES)
    except ValueError as error:
        raise UserError(f"{path} cannot be a saved configuration: {error}") from error
    text = content.decode()
    for token in yaml.scan(text):
        for kind, found in _REFUSED.items():
            if isinstance(token, kind):
                raise UserError(
                    f"line {token.start_mark.line + 1} of {path} has {found}, which no saved configuration does; "
                    "write the value itself"
                )
        # Would be resolved, to the value of an environment variable for instance. The text of the file may spell it
        # with escapes, as "\x24{".
        if isinstance(token, yaml.ScalarToken) and "${" in token.value:
            raise UserError(
                f"line {token.start_mark.line + 1} of {path} contains '${{', which no saved configuration does; "
                "write the value itself"
            )
        # Escape sequences in a message could make a terminal show another command than the one to type.
        if isinstance(token, yaml.ScalarToken) and has_controls(token.value):
            raise UserError(f"line {token.start_mark.line + 1} of {path} has characters that cannot be printed")
    saved: Any = OmegaConf.create(text)
    if not isinstance(saved, DictConfig):
        raise yaml.YAMLError("it has no keys")
    return saved
