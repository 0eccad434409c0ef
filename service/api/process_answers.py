"""What a process answers that looks at something of strangers for a request, under limits of its own."""

import json
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from service.problems import Problem


def body_of(content_type: str) -> dict[str, Any]:
    """The description, for OpenAPI, of a body that the framework does not parse."""
    schema = {"type": "string", "format": "binary"}
    return {"requestBody": {"content": {content_type: {"schema": schema}}, "required": True}}


def answer_of(
    module: str, words: Sequence[str], seconds: float, trouble: Problem, given: bytes | None = None
) -> dict[str, Any]:
    """The JSON that `python -m MODULE WORDS` prints. given: what it reads from stdin

    Raises Problem: `trouble`, where it fails or takes longer than so many seconds.
    """
    command = [sys.executable, "-m", module, *words]
    try:
        done = subprocess.run(command, input=given, capture_output=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        done = None
    if done is None or done.returncode != 0:
        raise trouble
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer
