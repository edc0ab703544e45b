"""Whole programs in a ROS domain of their own, on this machine only."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "nodes"))

from helpers import reserved_domain
from ros_fixtures import start

__all__ = ["start"]


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """The module's ROS domain, set for its child processes."""
    with reserved_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture
def wait_until() -> Callable[..., Any]:
    """``wait_until(condition, seconds, what)``: the condition's value once it is true; fails after `seconds`."""

    def wait(condition: Callable[[], Any], seconds: float, what: Callable[[], str]) -> Any:
        deadline = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < deadline, f"not within {seconds:g} s: {what()}"
            time.sleep(0.02)
        return value

    return wait


@pytest.fixture
def processes_naming() -> Callable[[Path], dict[str, int]]:
    """``processes_naming(path)``: module and process id of every process with `path` on its command line."""

    def find(path: Path) -> dict[str, int]:
        found = {}
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                words = (entry / "cmdline").read_text().split("\0")
            except OSError:
                continue
            modules = [word for word in words if word.startswith("mdf_nodes.")]
            if modules and any(str(path) in word for word in words):
                found[modules[0].removeprefix("mdf_nodes.")] = int(entry.name)
        return found

    return find
