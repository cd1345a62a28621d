"""`python docs/generate.py`: write the generated parts of the documentation.

The results are committed, so that the pages are complete on GitHub. Sphinx runs this at the start of every build, and
a test fails if a committed page differs.
"""

from pathlib import Path

from generator import (
    best_recipes,
    fresh_seeds,
    measured_tables,
    recipe_tables,
    scaling,
    score_tables,
    seed_tables,
    setting_tables,
    task_pages,
)
from generator.markdown import toctree, with_block

from mjx_walk import zoo
from mjx_walk.algos import BUILT_IN_ALGORITHMS
from mjx_walk.envs import BUILT_IN_TASKS

DOCS = Path(__file__).parent
_OF_SCORES = (
    *("best_evaluations", "complete_episodes", "cpu", "cpu_tasks"),
    *("hills", "mujoco_versions", "robustness", "slm_lab_drafts"),
)
"""Tables of measured/ that results.md shows. speed.md shows the others, except that of robots."""
_ROBOTS = "robots"
"""The table of measured/ that your_own.md shows."""


def pages() -> dict[Path, str]:
    """Every page with generated parts, as it must be, by its path."""
    found = {DOCS / "tasks" / f"{name}.md": task_pages.page(name) for name in task_pages.NAMES}
    index = {"tasks": task_pages.overview_of_all(), "pages": toctree(task_pages.NAMES)}
    found[DOCS / "tasks" / "index.md"] = _filled("tasks/index.md", index)
    groups = {name: setting_tables.group_table(name) for name in setting_tables.GROUPS}
    found[DOCS.parent / "README.md"] = _filled("../README.md", {"best": best_recipes.summary()})
    found[DOCS / "claims.md"] = _filled("claims.md", {"claims": score_tables.claims()})
    for page, blocks in _figures().items():
        found[DOCS / page] = _filled(page, blocks)
    found[DOCS / "training.md"] = _filled("training.md", {"scaling-summary": scaling.summary()})
    found[DOCS / "tuning.md"] = _filled("tuning.md", {"ranges": setting_tables.search_ranges()})
    robots = {name: setting_tables.task_tables(name) for name in BUILT_IN_TASKS if name not in task_pages.NAMES}
    found[DOCS / "your_own.md"] = _filled("your_own.md", robots | {_ROBOTS: measured_tables.all_in(".")[_ROBOTS]})
    groups["presets"] = setting_tables.presets()
    found[DOCS / "configuration.md"] = _filled("configuration.md", groups)
    texts = {name: (DOCS / "algorithms" / f"{name}.md").read_text() for name in BUILT_IN_ALGORITHMS}
    index = {"algorithms": setting_tables.algorithms(texts), "pages": toctree(BUILT_IN_ALGORITHMS)}
    found[DOCS / "algorithms" / "index.md"] = _filled("algorithms/index.md", index)
    for name in BUILT_IN_ALGORITHMS:
        blocks = {"settings": setting_tables.algorithm_table(name), "scores": score_tables.of_algorithm(name)}
        blocks["recipes"] = recipe_tables.differences(name)
        found[DOCS / "algorithms" / f"{name}.md"] = _filled(f"algorithms/{name}.md", blocks)
    return found


def _figures() -> dict[str, dict[str, str]]:
    """The tables of the pages of measurements, by page and block."""
    measured, archived = measured_tables.all_in("."), measured_tables.all_in("archive")
    scores = {"all-tasks": best_recipes.detailed(), "comparison": best_recipes.comparison()}
    scores |= {"recipes": score_tables.recipes(), "suite": score_tables.suite(), "zoo": zoo.table()}
    scores |= {"published": score_tables.published(True), "published-runs": score_tables.published(False)}
    scores |= {"frozen-seeds": fresh_seeds.seeds(), "frozen-means": fresh_seeds.means()}
    scores["frozen-budgets"] = fresh_seeds.budgets()
    scores |= {"csac-seeds": seed_tables.csac_seeds(), "csac-means": seed_tables.csac_means()}
    scores |= {"fresh-seeds": seed_tables.other_algorithms(), "ppo-suite": seed_tables.ppo_on_other_tasks()}
    scores |= {name: measured.pop(name) for name in _OF_SCORES}
    del measured[_ROBOTS]
    archived["six-algorithms"] = seed_tables.six_algorithms()
    speeds = {"scaling": scaling.detailed(), **measured}
    return {"results.md": scores, "speed.md": speeds, "results_archive.md": archived}


def _filled(name: str, blocks: dict[str, str]) -> str:
    """A handwritten page with its generated blocks."""
    page = (DOCS / name).read_text()
    for block, content in blocks.items():
        try:
            page = with_block(page, block, content)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return page


def write() -> None:
    """Write the pages that have changed."""
    for path, text in pages().items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


if __name__ == "__main__":
    write()
