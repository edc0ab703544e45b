"""What the node tests share: a running graph to wait on, and processes of the cell."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from mdf_nodes.context import child_environment

REPOSITORY = Path(__file__).resolve().parents[2]
_PATIENCE_SECONDS = 6.0
_STATE_AFTER = {
    Transition.TRANSITION_CONFIGURE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_CLEANUP: State.PRIMARY_STATE_UNCONFIGURED,
}


class Graph:
    """The test's own nodes, run in the test's thread while it waits."""

    def __init__(self) -> None:
        self.executor = SingleThreadedExecutor()
        self.nodes: list[Node] = []

    def node(self, name: str, **options: Any) -> Node:
        """A new node."""
        return self.add(Node(name, **options))

    def add(self, node: Any) -> Any:
        """A node made elsewhere; it is destroyed with the graph."""
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def wait_until(self, condition: Callable[[], Any], seconds: float = 40.0, what: str = "") -> Any:
        """Run callbacks until `condition` is true and return its value; fail when that takes longer than `seconds`."""
        deadline = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < deadline, f"not within {seconds:g} s: {what or condition}"
            self.executor.spin_once(timeout_sec=0.02)
        return value

    def result(self, future: Any, seconds: float = 40.0) -> Any:
        """The result of a service or action future."""
        self.wait_until(future.done, seconds, "an answer")
        return future.result()

    def call(self, client: Any, request: Any, seconds: float = 40.0) -> Any:
        """The response of the service behind `client`; the request may be sent twice, see `answer`."""
        self.wait_until(client.service_is_ready, seconds, f"service {client.srv_name}")
        return self.answer(lambda: client.call_async(request), seconds, client.srv_name)

    def answer(self, ask: Callable[[], Any], seconds: float, what: str) -> Any:
        """The result of the future that `ask` returns.

        A client finds a service before the service finds the client, and then request or answer may get lost
        (rmw_fastrtps, issue 392). An answer that does not come is asked for again, so what is asked for must bear being
        done twice.
        """
        deadline = time.monotonic() + seconds
        futures: list[Any] = []
        while not any(future.done() for future in futures):
            futures.append(ask())
            try:
                self.wait_until(lambda: any(future.done() for future in futures), _PATIENCE_SECONDS)
            except AssertionError:
                assert time.monotonic() < deadline, f"no answer from {what} within {seconds:g} s"
        return next(future.result() for future in futures if future.done())

    def change_state(self, name: str, *transitions: int) -> bool:
        """Lead the lifecycle node `name` through the transitions; whether all succeeded."""
        change = self.nodes[0].create_client(ChangeState, f"{name}/change_state")
        state = self.nodes[0].create_client(GetState, f"{name}/get_state")
        return all(self._change_state(change, state, transition) for transition in transitions)

    def _change_state(self, change: Any, state: Any, transition: int) -> bool:
        self.wait_until(change.service_is_ready, what=f"service {change.srv_name}")
        future = change.call_async(ChangeState.Request(transition=Transition(id=transition)))
        try:
            return self.result(future, _PATIENCE_SECONDS).success
        except AssertionError:
            # Request or answer is lost, see `call`; only the state tells which.
            if self.call(state, GetState.Request()).current_state.id == _STATE_AFTER[transition]:
                return True
            return self.call(change, ChangeState.Request(transition=Transition(id=transition))).success

    def collect(self, type_: Any, topic: str, qos: Any, **options: Any) -> list[Any]:
        """A list that every message of `topic` is appended to."""
        received: list[Any] = []
        node = self.nodes[0] if self.nodes else self.node("collector")
        node.create_subscription(type_, topic, received.append, qos, **options)
        return received

    def close(self) -> None:
        """Destroy all nodes."""
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()


class CellProcess:
    """One executable of the cell in a process of its own; its output goes to files, which never block it."""

    def __init__(self, module: str, arguments: tuple[str, ...], folder: Path, **environment: str) -> None:
        self._stdout, self._stderr = folder / "stdout", folder / "stderr"
        with self._stdout.open("wb") as stdout, self._stderr.open("wb") as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"mdf_nodes.{module}", *arguments],
                cwd=REPOSITORY,
                env=child_environment(PYTHONUNBUFFERED="1", **environment),
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
            )

    @property
    def stdout(self) -> str:
        return self._stdout.read_text()

    @property
    def stderr(self) -> str:
        return self._stderr.read_text()

    @property
    def output(self) -> str:
        """stdout and stderr."""
        return self.stdout + self.stderr

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def open_files(self) -> set[str]:
        """The paths of the files that the process has open."""
        return {str(entry.readlink()) for entry in Path(f"/proc/{self._process.pid}/fd").iterdir()}

    def send(self, signal_number: int = signal.SIGINT) -> None:
        """Send a signal."""
        self._process.send_signal(signal_number)

    def wait_for(self, text: str, seconds: float = 60.0) -> None:
        """Return when the process has told `text`; fails when it takes longer or has ended."""
        deadline = time.monotonic() + seconds
        while text not in self.output:
            assert self.running and time.monotonic() < deadline, self.output
            time.sleep(0.02)

    def wait(self, seconds: float = 30.0) -> int:
        """The exit status; fails with the output when it takes longer than `seconds`."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {seconds:g} s:\n{self.output}") from None

    def stop(self, seconds: float = 10.0) -> int:
        """Interrupt, as Ctrl-C does; the exit status."""
        if self.running:
            self.send()
        return self.wait(seconds)

    def terminate(self) -> None:
        """Tell the process to end."""
        if self.running:
            self.send(signal.SIGTERM)

    def close(self) -> None:
        """Make sure that nothing is left behind, and show the output, which pytest prints with a failed test."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self.running:
                self.send(number)
                try:
                    self._process.wait(5.0)
                except subprocess.TimeoutExpired:
                    continue
        print(f"{' '.join(self._process.args)}\n{self.output}")


def set_parameters(node: Node, **values: Any) -> None:
    """Set parameters of a node in this process."""
    results = node.set_parameters([Parameter(name, value=value) for name, value in values.items()])
    assert all(result.successful for result in results), results


@contextmanager
def reserved_domain() -> Iterator[int]:
    """A ROS domain that no other test process on this machine uses.

    A bound port is the lock: it goes with the process, whatever happens to it.
    """
    for domain in range(1, 102):
        with socket.socket() as lock:
            try:
                lock.bind(("127.0.0.1", 23000 + domain))
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError("all ROS domains are in use")
