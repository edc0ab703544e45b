"""Fixtures of every test that talks to nodes: a ROS domain on this machine only, the test's own nodes, processes."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from helpers import CellProcess, Graph, reserved_domain
from rclpy.signals import SignalHandlerOptions

from mdf_nodes.context import tune_dds


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[int]:
    """The module's ROS domain, set for this process and its children; rclpy is initialised in it."""
    with reserved_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        tune_dds()
        # rclpy's own handlers would keep SIGTERM from pytest.
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        yield number
        rclpy.try_shutdown()
        # Nodes refer to themselves; until they are collected they stay in the domain, which the next module may get.
        gc.collect()


@pytest.fixture
def graph() -> Iterator[Graph]:
    """The test's own nodes."""
    own = Graph()
    yield own
    own.close()


@pytest.fixture
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., CellProcess]]:
    """``start("bag_player", "arguments", ...)`` starts ``python -m mdf_nodes.bag_player``; ended with the test."""
    processes: list[CellProcess] = []

    def start_process(module: str, *arguments: str | Path, **environment: str) -> CellProcess:
        texts = tuple(str(argument) for argument in arguments)
        processes.append(CellProcess(module, texts, tmp_path_factory.mktemp(module), **environment))
        return processes[-1]

    yield start_process
    for process in processes:
        process.terminate()
    for process in processes:
        process.close()
