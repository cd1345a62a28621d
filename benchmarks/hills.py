"""`python benchmarks/hills.py zoo:walker2d-csac [RUN …]`: mean returns of policies on each preset of hills, on `c`.

Each mean is of 20 episodes, with the reward of the flat floor. It takes the best policy of a run.
"""

import dataclasses
import sys

import mjx_walk
from mjx_walk.api import deterministic_policy
from mjx_walk.envs.ground.options import PRESETS
from mjx_walk.evaluation.gymnasium_scores import compile_episodes, score_in_sim
from mjx_walk.evaluation.saved_policies import make_task

EPISODES = 20


def main(runs: list[str]) -> None:
    print("Run", *PRESETS, sep="\t")
    for name in runs:
        run = mjx_walk.load_run(name, physics="c")
        means = []
        for ground in PRESETS.values():
            env = dataclasses.replace(run.config.env, ground=ground)
            task = make_task(dataclasses.replace(run.config, env=env, physics="c"))
            episodes = compile_episodes(task, deterministic_policy(run.algorithm, run.policy_params))
            means.append(score_in_sim(task, episodes, EPISODES).returns.mean())
        print(name, *(f"{mean:.1f}" for mean in means), sep="\t", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
