"""`python -m mjx_walk.export run=RUN_DIR`: a policy as a file that needs neither JAX nor this package."""

import dataclasses
from pathlib import Path

from mjx_walk import zoo
from mjx_walk.api import load_run
from mjx_walk.utils import cli
from mjx_walk.utils.errors import UserError
from mjx_walk.utils.settings import setting

USAGE = """
usage: python -m mjx_walk.export run=RUN_DIR|zoo:NAME [format=onnx] [out=FILE.onnx]

  out=FILE.onnx   by default RUN_DIR/policy.onnx, or NAME.onnx here for a policy of the zoo. Its input `observation`,
                  [N, observation_size] f64, and its output `action`, [N, action_size] f32, are Gymnasium's; what
                  observations are normalised by is inside.
"""


@dataclasses.dataclass
class Arguments:
    run: str | None = None
    format: str = setting("onnx", choices=("onnx",))
    out: str | None = None


def main(arguments: list[str]) -> None:
    """Write the file."""
    parsed = cli.parse(Arguments, arguments, USAGE)
    cli.stay_on_cpu()
    if parsed.run is None:
        raise UserError(f"say which run: run=RUN_DIR, or {zoo.PREFIX}NAME")
    try:
        import onnx

        from mjx_walk.interop.onnx import translate
    except ImportError as error:
        raise UserError("format=onnx needs ONNX: pip install onnx") from error
    folder = zoo.open_run(parsed.run)
    run = load_run(parsed.run, "c")
    path = Path(parsed.out) if parsed.out else zoo.output_path(folder, "policy.onnx")
    cli.check_writable(path)
    model = translate(run.act, run.task.observation_size, f"{run.config.env.name}_{run.config.algo.name}")
    onnx.save(model, str(path))
    print(f"{path}: observation [N, {run.task.observation_size}] → action [N, {run.task.action_size}]")


if __name__ == "__main__":
    cli.main(main)
