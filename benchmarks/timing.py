"""Measure times with little influence of other programs on the machine."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Timing:
    """CPU seconds of one thread per call."""

    median: float
    p95: float
    p99: float
    least: float


def time_calls(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, Timing]:
    """Time calls in turn, so that other programs on the machine slow all of them alike.

    The time is the CPU time of this thread. Other processes do not count; other threads must
    not work (`torch.set_num_threads(1)`).
    """
    for call in calls.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.thread_time()
            call()
            seconds[name].append(time.thread_time() - start)
    return {
        name: Timing(
            median=statistics.median(values),
            least=min(values),
            p95=_percentile(values, 0.95),
            p99=_percentile(values, 0.99),
        )
        for name, values in seconds.items()
    }


def _percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]
