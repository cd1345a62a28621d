"""`python docs/scaling_figure.py`: draw scaling.png from the rows on several GPUs in experiments.csv."""

from pathlib import Path

import matplotlib.figure
from generator.scaling import ON_ONE_GPU, factors, summary

DOCS = Path(__file__).parent


def main() -> None:
    """Draw the figure."""
    figure = matplotlib.figure.Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot((1, 2, 4), (1, 2, 4), color="0.5", linestyle="--", label="ideal")
    for number, (algorithm, num_envs) in enumerate(ON_ONE_GPU.items()):
        for same_total, style, down in ((False, "-", 0), (True, ":", 4)):
            values = {1: 1.0} | factors(algorithm, same_total)
            label = f"{algorithm}, {num_envs:,} {'in total' if same_total else 'environments on each'}"
            axes.plot(values.keys(), values.values(), style, color=f"C{number}", marker="o", label=label)
            offset = (6, -down - 4 * number * (not same_total))
            axes.annotate(f"{values[4]:.2f}", (4, values[4]), offset, textcoords="offset points")
    axes.set_xticks((1, 2, 4))
    axes.set_yticks((1, 2, 4))
    axes.set_xlim(right=4.4)
    axes.set_xlabel("H200 GPUs of one host")
    axes.set_ylabel("steps per second, relative to one GPU")
    axes.set_title("Training Humanoid-v5")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    # The test compares the picture with the table by this entry.
    figure.savefig(DOCS / "scaling.png", dpi=110, metadata={"Description": summary()})


if __name__ == "__main__":
    main()
