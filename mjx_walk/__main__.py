"""`mjx-walk COMMAND`, or `python -m mjx_walk COMMAND`: run a command, or list all of them."""

import ast
import importlib
import sys
from pathlib import Path

from mjx_walk.cli.console import console
from mjx_walk.utils.near_misses import near_misses
from mjx_walk.utils.versions import __version__

__all__ = ["COMMANDS", "main", "usage"]

COMMANDS = ("train", "eval", "play", "plots", "export", "zoo", "compare", "tune", "bench", "parity")
_PACKAGES = ("zoo",)
"""Commands that are packages."""
_OTHER_NAMES = {
    "train": ("learn",),
    "eval": ("evaluate", "score", "test"),
    "play": ("enjoy", "record", "render", "video", "view", "watch"),
    "plots": ("draw",),
    "zoo": ("list",),
    "tune": ("optimize", "search"),
    "bench": ("benchmark",),
    "--version": ("v", "version"),
}
"""The names that other tools have for our commands."""


def main() -> int:
    """Run the command that the arguments name, and return the exit code. Without one, list the commands."""
    command, *arguments = sys.argv[1:] or ["--help"]
    if command not in COMMANDS:
        with console():
            return _without_command(command)
    from mjx_walk.cli import parsing  # imports JAX, which the list of commands does not need

    module = importlib.import_module(f"mjx_walk.{_module(command)}")
    sys.argv = [f"mjx-walk {command}", *arguments]
    parsing.main(module.main)


def _without_command(command: str) -> int:
    """Show the list of commands or the version, or say what is wrong."""
    if command in ("-h", "--help", "help"):
        print(usage())
        return 0
    if command == "--version":
        print(f"mjx_walk {__version__}")
        return 0
    meant = _meant(command)
    first = "the command comes first; " if command.startswith("-") else ""
    hint = f"did you mean: {meant}?" if meant else f"{first}choose one of: {', '.join(COMMANDS)}"
    print(f"error: unknown command '{command}'; {hint}", file=sys.stderr)
    return 2


def _meant(argument: str) -> str:
    """Suggest what an argument in the place of the command may mean, or nothing."""
    key, equals, _ = argument.lstrip("-").partition("=")
    if argument.startswith("zoo:"):
        return f"play run={argument}"
    if equals and not argument.startswith("-"):
        return f"play {argument}" if key == "run" else f"train {argument}"
    commands = {other: command for command, others in _OTHER_NAMES.items() for other in others}
    near = near_misses(key, (*COMMANDS, *commands), 1)
    return commands.get(near[0], near[0]) if near else ""


def usage() -> str:
    """The commands, each with the example and the sentence of its docstring."""
    lines = [
        "usage: mjx-walk COMMAND [KEY=VALUE ...]",
        "",
        "The same as python -m mjx_walk.COMMAND [KEY=VALUE ...]. mjx-walk COMMAND --help says more.",
        "",
    ]
    for command in COMMANDS:
        path = Path(__file__).parent / f"{_module(command).replace('.', '/')}.py"
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        example, _, sentence = docstring.splitlines()[0].partition("`: ")
        example = example.removeprefix(f"`python -m mjx_walk.{command}").strip()
        lines += [f"  mjx-walk {command} {example}".rstrip(), f"      {sentence.replace('`', '')}"]
    return "\n".join(lines)


def _module(command: str) -> str:
    return f"{command}.__main__" if command in _PACKAGES else command


if __name__ == "__main__":
    sys.exit(main())
