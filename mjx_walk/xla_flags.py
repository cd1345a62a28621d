"""XLA's flags, which it reads from the environment when JAX is first used."""

import os

_FUSION_TYPE = "--xla_cpu_experimental_ynn_fusion_type"


def turn_off_wrong_reductions() -> None:
    """Have XLA compile reductions on a CPU itself, unless `XLA_FLAGS` says who is to.

    From jaxlib 0.10.2 on it hands those over large batches to YNNPACK, which then reads memory that was never written.
    It sums wrongly in 0.10.2 (jax-ml/jax#39103), and MJX's steps are not finite in 0.11.2 either, as soon as new memory
    holds something else than zeros (`MALLOC_PERTURB_=128`).
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FUSION_TYPE not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_FUSION_TYPE}=-reduce".lstrip()
