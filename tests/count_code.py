"""`python tests/count_code.py [TREE]`: sizes of a tree's product code and the shape of its import graph."""

import ast
import functools
import io
import sys
import tokenize
import tomllib
from pathlib import Path

import grimp

HERE = Path(__file__).resolve().parents[1]
CONTRACT = tomllib.loads((HERE / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
LAYER_OF = {name: layer for layer, names in enumerate(CONTRACT["layers"]) for name in names.split(" | ")}
NO_CODE = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def main(tree: Path) -> None:
    files = {path.resolve() for root in ("mjx_walk", "envs") for path in (tree / root).rglob("*.py")}
    sources = [path.read_text() for path in sorted(files)]
    functions = [node for text in sources for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    length, longest = max((node.end_lineno - node.lineno + 1, node.name) for node in functions)
    sys.path.insert(0, str(tree))
    graph = grimp.build_graph("mjx_walk", cache_dir=None, exclude_type_checking_imports=True)
    modules = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    pairs = {(room(name), room(other)) for name, imported in modules.items() for other in imported}
    rooms = {room(name): {other for this, other in pairs if this == room(name) != other} for name in modules}
    upward = [f"{name} -> {other}" for name in modules for other in modules[name] if layer(other) < layer(name)]
    upward = sorted({*upward} - {*CONTRACT["ignore_imports"]})
    print(f"modules at the top of mjx_walk  {len([*(tree / 'mjx_walk').glob('*.py')]) - 1}")
    print(f"imports up the layers           {len(upward)} {upward or ''}")
    print(f"floors of {len(modules):>3} modules           {floors(modules)}")
    print(f"floors of {len(rooms):>3} rooms             {floors(rooms)}")
    print(f"lines of the longest function   {length} ({longest})")
    print(f"functions inside functions      {sum(map(num_inner, functions))}")
    print(f"lines of product code           {sum(map(num_code_lines, sources))}")
    with_any = sum(map(says_any, functions))
    base = ast.walk(ast.parse((tree / "mjx_walk/algos/base.py").read_text()))
    of_base = sum(says_any(node) for node in base if isinstance(node, ast.FunctionDef))
    print(f"signatures with Any             {with_any} of {len(functions)}, {of_base} in algos/base.py")
    firsts = [text.split(maxsplit=1)[0] for source in sources for text in docstrings(source) if text.strip()]
    print(f"docstrings that begin with What {firsts.count('What')} of {len(firsts)}")


def room(module: str) -> str:
    return module.removeprefix("mjx_walk").lstrip(".").partition(".")[0]


def layer(module: str) -> float:
    """The module's place in the contract, from the top down; NaN for rooms that it does not name."""
    return LAYER_OF.get(room(module), float("nan"))


def num_inner(node: ast.AST) -> int:
    """Functions directly inside a function, those in its branches and loops included."""
    children = [child for child in ast.iter_child_nodes(node) if not isinstance(child, ast.ClassDef)]
    return sum(1 if isinstance(child, ast.FunctionDef) else num_inner(child) for child in children)


def num_code_lines(source: str) -> int:
    """Lines without blank lines, comments and docstrings, those of fields included."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    lines = {line for token in tokens if token.type not in NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    texts = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Expr)]
    texts = [node for node in texts if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)]
    return len(lines - {line for node in texts for line in range(node.lineno, node.end_lineno + 1)})


def says_any(function: ast.FunctionDef) -> bool:
    """Whether the signature has an `Any`, in an argument or in what it returns."""
    every = function.args
    arguments = [*every.posonlyargs, *every.args, *every.kwonlyargs, every.vararg, every.kwarg]
    hints = [argument.annotation for argument in arguments if argument] + [function.returns]
    nodes = [node for hint in hints if hint for node in ast.walk(hint)]
    return any("Any" in (getattr(node, "id", ""), getattr(node, "attr", "")) for node in nodes)


def docstrings(source: str) -> list[str]:
    """Docstrings of modules, classes, functions, fields and constants."""
    nodes = [node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Expr)]
    return [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]


def floors(imports: dict[str, set[str]]) -> int:
    """Length of the longest chain of imports. A circle counts as one."""
    reach = dict(imports)
    for _ in imports:
        reach = {name: found.union(*(reach[other] for other in found)) for name, found in reach.items()}

    @functools.cache
    def floor(name: str) -> int:
        circle = {name} | {other for other in reach[name] if name in reach[other]}
        return 1 + max((floor(other) for member in circle for other in imports[member] - circle), default=0)

    return max(map(floor, imports))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else HERE).resolve())
