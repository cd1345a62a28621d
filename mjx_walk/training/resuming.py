"""The configuration of a resumed run: the saved one, and what a command line may change of it."""

import operator
import shlex
from pathlib import Path

from mjx_walk.envs.user_files import only_known, source_path
from mjx_walk.settings.config import Config
from mjx_walk.settings.input_files import check_inputs
from mjx_walk.settings.renamed import present_key
from mjx_walk.settings.saved_config import read_saved_config, with_setting
from mjx_walk.settings.trust import require_trusted
from mjx_walk.storage.run_folder import RunFolder, open_existing
from mjx_walk.utils.errors import UserError

__all__ = ["as_saved"]


def as_saved(config: Config, overrides: list[str]) -> Config:
    """The saved configuration with the given settings, if a run is resumed without naming its task or algorithm.

    Raises:
        UserError: a file that the run reads has changed; or the saved run has a reward function that neither the
            overrides name nor the user has named before, or logs to Weights & Biases, and the overrides do not say so.
            A folder must not run code or upload.
    """
    if config.env.reward_function:
        only_known(source_path(config.env.reward_function), None)
    given = {present_key(override.partition("=")[0]) for override in overrides}
    if not (config.resume and config.run_dir):
        return config
    if given & {"env", "algo", "recipe"}:
        check_inputs(RunFolder(Path(config.run_dir)), config.env, config.env)
        return config
    folder = open_existing(config.run_dir)
    saved = read_saved_config(folder)
    source = saved.env.reward_function
    if source and "env.reward_function" not in given:
        require_trusted(source)
    check_inputs(folder, saved.env, config.env)
    project = saved.wandb_project
    if project and "wandb_project" not in given:
        named = shlex.quote(f"wandb_project={project}")
        raise UserError(f"the saved run logs to Weights & Biases; to go on, add {named}, or wandb_project=null")
    for key in given - {"hardware"} | {"run_dir", "resume"}:
        saved = with_setting(saved, key, operator.attrgetter(key)(config))
    return saved
