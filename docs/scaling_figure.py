"""`python docs/scaling_figure.py`: draw scaling.png from the rows on several GPUs in experiments.csv."""

from pathlib import Path

import matplotlib.figure
from generator.score_tables import read

DOCS = Path(__file__).parent
SERIES = {
    "PPO, 16,384 environments on each": ("SP47", "SP48", "SP49"),
    "PPO, 16,384 in total": ("SP47", "SP50", "SP51"),
    "csac, 2,048 environments on each": ("SP52", "SP53", "SP54"),
    "csac, 2,048 in total": ("SP52", "SP55", "SP56"),
}
"""Arms on 1, 2 and 4 GPUs."""
GPUS = (1, 2, 4)


def factors() -> dict[str, list[float]]:
    """Speed of each series, in multiples of that on one GPU."""
    speeds = {row["id"]: float(row["final_mean"]) for row in read("experiments.csv") if row["measure"] == "speed"}
    return {label: [speeds[arm] / speeds[arms[0]] for arm in arms] for label, arms in SERIES.items()}


def main() -> None:
    """Draw the figure."""
    figure = matplotlib.figure.Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(GPUS, GPUS, color="0.5", linestyle="--", label="ideal")
    for number, (label, values) in enumerate(factors().items()):
        style = "-" if number % 2 == 0 else ":"
        axes.plot(GPUS, values, style, color=f"C{number // 2}", marker="o", label=label)
        axes.annotate(
            f"{values[-1]:.2f}", (GPUS[-1], values[-1]), (6, (0, -4, -8, -4)[number]), textcoords="offset points"
        )
    axes.set_xticks(GPUS)
    axes.set_yticks(GPUS)
    axes.set_xlim(right=4.4)
    axes.set_xlabel("H200 GPUs of one host")
    axes.set_ylabel("steps per second, relative to one GPU")
    axes.set_title("Training Humanoid-v5")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(DOCS / "scaling.png", dpi=110)


if __name__ == "__main__":
    main()
