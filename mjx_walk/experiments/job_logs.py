"""The output of trainings that other processes have started."""

import re
from pathlib import Path

__all__ = ["failure_reason"]

_LAST_CHARACTERS = 10_000


def failure_reason(log: Path, advice: str) -> str:
    """Why a training has ended: the line of its error, or of its exception. Empty if the log has neither.

    Args:
        log: output of its process.
        advice: what to try if memory ran out.
    """
    text = log.read_text(encoding="utf-8", errors="replace")[-_LAST_CHARACTERS:]
    if "RESOURCE_EXHAUSTED" in text:
        return f"memory ran out, {advice}"
    found = re.findall(r"^(?:error: (.+)|([\w.]+(?:Error|Exception)\b.*))$", text, re.MULTILINE)
    return "".join(found[-1]) if found else ""
