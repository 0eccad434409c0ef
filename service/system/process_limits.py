"""Limits of a process that decodes what strangers sent."""

import resource


def limit(memory: int, seconds: int) -> None:
    """Of this process, from now on: address space (bytes), processor time (s), and no core dumps."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
