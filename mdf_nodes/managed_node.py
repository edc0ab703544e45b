"""What the nodes of the cell share: lifecycle, threads, jobs, the error boundary, diagnostics."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from mdf_core.errors import CancelledError, MdfError, NotActiveError
from mdf_nodes.context import DONE, exit_status, only_ros_arguments, ros_context
from mdf_nodes.conversions import describe
from mdf_nodes.jobs import Job, JobQueue
from mdf_nodes.parameters import declare
from mdf_nodes.qos import REQUESTS

T = TypeVar("T")
_SPARE_THREADS = 6
_ANSWER_SECONDS = 1.0
_SEND_SECONDS = 0.2
_PAUSE_SECONDS = 0.1
_RETRY_SECONDS = 10.0


class ManagedNode(LifecycleNode):
    """A lifecycle node that no input and no client brings down.

    The node itself runs in several threads, so that goals, timers, parameters and diagnostics go on while one callback
    waits. What may hold a thread for long gets an inner node with a thread of its own: large clouds (`inner_node`),
    because rclpy's multi-threaded executor takes seconds for them, and services that answer when their job is done
    (`serve`).

    Subclasses declare and create everything in ``__init__`` and override `configure`, `activate`, `deactivate` and
    `close`, which raise `MdfError` when they cannot.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._outlive_invalid_transitions()
        declare(self, "autostart", True, "Configure and activate right after the start", read_only=True)
        declare(
            self,
            "queue_size",
            8,
            "Most jobs that wait; more are refused with QUEUE_FULL",
            minimum=1,
            maximum=1000,
            read_only=True,
        )
        queue_size = self.get_parameter("queue_size").value
        # One thread for each goal that waits for its job, and some for the rest: rclpy burns CPU when none is free.
        self._executors: dict[Node, Executor] = {self: MultiThreadedExecutor(queue_size + _SPARE_THREADS)}
        self._service_node = self.inner_node("services")
        self._threads: list[threading.Thread] = []
        self._stopping = threading.Event()
        self._jobs: JobQueue | None = None
        self._answers_pending = 0
        self._last_answer = -math.inf
        self._answered = threading.Condition()
        self._done = self._failed = 0
        self._last_job = self._last_error = ""
        self._last_failure = ""  # what the cell has to be mended of; empty: nothing since a job was done
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_steady_timer(1.0, self._publish_diagnostics)

    # For subclasses

    def configure(self) -> None:
        """Load and validate."""

    def activate(self) -> None:
        """Begin to work; the lifecycle publishers are enabled."""

    def deactivate(self) -> None:
        """Stop working; no job is left."""

    def close(self) -> None:
        """Close what `configure` has opened, if it has."""

    def diagnostics(self) -> dict[str, Any]:
        """More lines for the node's diagnostics."""
        return {}

    def inner_node(self, purpose: str) -> Node:
        """A hidden node with one thread of its own.

        Its topics and services must be named by `resolve_topic_name` and `resolve_service_name` of this node: it takes
        no remappings itself, because one that renames this node would give both the same name.
        """
        inner = Node(
            f"_{self.get_name()}_{purpose}",
            namespace=self.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._executors[inner] = SingleThreadedExecutor()
        return inner

    def serve(self, type_: Any, name: str, on_request: Callable[[Any, Any], Any]) -> None:
        """A service that may answer only when its job is done: the requests of many clients wait for their turn."""
        self._service_node.create_service(type_, self.resolve_service_name(name), on_request, qos_profile=REQUESTS)

    def create_steady_timer(self, seconds: float, callback: Callable[[], None]) -> None:
        """A timer that also runs while simulated time stands still."""
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(seconds, callback, callback_group=MutuallyExclusiveCallbackGroup(), clock=clock)

    @property
    def is_active(self) -> bool:
        """Whether jobs are taken."""
        return self._jobs is not None

    def require_active(self) -> JobQueue:
        """The queue that takes jobs.

        Raises
        ------
        NotActiveError
            The node is not active.
        """
        jobs = self._jobs
        if jobs is None:
            is_finalized = self._state_machine.current_state[0] == State.PRIMARY_STATE_FINALIZED
            remedy = "it was shut down: start it again" if is_finalized else "configure and activate it"
            raise NotActiveError("the node is not active", self.get_name(), remedy)
        return jobs

    def require_configured(self, opened: T | None) -> T:
        """What `configure` has opened.

        Raises
        ------
        NotActiveError
            It has not yet.
        """
        if opened is None:
            raise NotActiveError("the node is not configured", self.get_name(), "configure and activate it")
        return opened

    def job_done(self, summary: str) -> None:
        """Tell of a job that is done: one line in the log, and the diagnostics."""
        self.get_logger().info(summary)
        self._done += 1
        self._last_job, self._last_failure = summary, ""

    def report(self, error: Exception, is_refusal: bool = False) -> MdfError:
        """Tell of an error in log and diagnostics; as an `MdfError`, whose code and message are the answer.

        A request that is refused is its client's error and not one of the cell.
        """
        reported = self._as_mdf_error(error)
        line = describe(reported)
        if isinstance(error, CancelledError):
            self.get_logger().info(line)
        else:
            trace = "" if reported is error else "\n" + "".join(traceback.format_exception(error))
            self.get_logger().error(line + trace)
            self._failed += 1
            self._last_error = line
            if not is_refusal:
                self._last_failure = line
        return reported

    def _as_mdf_error(self, error: Exception) -> MdfError:
        if isinstance(error, MdfError):
            return error
        return MdfError(f"a fault of the software: {error!r}", self.get_name(), "report it with the trace in the log")

    @contextmanager
    def error_boundary(self, answer: Any = None) -> Iterator[None]:
        """No exception leaves this block; it is reported, and told in the answer's error_code and error_msg."""
        with nullcontext() if answer is None else self.answering():
            try:
                yield
            except Exception as error:
                reported = self.report(error, is_refusal=answer is not None)
                if answer is not None:
                    answer.error_code, answer.error_msg = reported.code, str(reported)

    @contextmanager
    def answering(self) -> Iterator[None]:
        """A stop of the node waits for this block."""
        with self._answered:
            self._answers_pending += 1
        try:
            yield
        finally:
            with self._answered:
                self._answers_pending -= 1
                self._last_answer = time.monotonic()
                self._answered.notify_all()

    def run_job(self, work: Callable[[Job[Any]], Any]) -> Any:
        """Queue a job, wait for it, and return its result or raise its exception."""
        return self.result_of(self.require_active().submit(Job(work)))

    def result_of(self, job: Job[Any]) -> Any:
        """Wait for a job; its result, or its exception, of which the diagnostics tell until a job succeeds."""
        try:
            result = job.result()
        except Exception as error:
            if not isinstance(error, CancelledError | NotActiveError):
                self._last_failure = describe(self._as_mdf_error(error))
            raise
        self._last_failure = ""
        return result

    # Start and stop

    def start(self) -> None:
        """Spin in threads of its own; configure and activate first if autostart is set, and until that succeeds."""
        if self.get_parameter("autostart").value and not self._autostart():
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            # In the group of the lifecycle services: two transitions at once must not be.
            self._retry = self.create_timer(_RETRY_SECONDS, self._autostart_again, clock=clock)
        for node, executor in self._executors.items():
            executor.add_node(node)
            self._threads.append(
                threading.Thread(target=self._spin, args=(executor,), name=node.get_name(), daemon=True)
            )
        for thread in self._threads:
            thread.start()

    def _autostart(self) -> bool:
        """Whether nothing is left to try: a disk that is full or a file that is missing may be mended meanwhile."""
        if self.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            return False
        if self.trigger_activate() != TransitionCallbackReturn.SUCCESS:
            self.trigger_cleanup()
            return False
        return True

    def _autostart_again(self) -> None:
        is_unconfigured = self._state_machine.current_state[0] == State.PRIMARY_STATE_UNCONFIGURED
        if not is_unconfigured or self._autostart():  # or somebody else has seen to it
            self._retry.cancel()

    def stop(self) -> None:
        """Answer what is under way with NOT_ACTIVE, end the threads and destroy the node."""
        self._close_jobs("the node is shutting down")
        with self._answered:
            self._answered.wait_for(lambda: self._answers_pending == 0, _ANSWER_SECONDS)
        # rclpy sends answers later, those of goals in another thread, and does not tell when.
        time.sleep(max(0.0, self._last_answer + _SEND_SECONDS - time.monotonic()))
        self._stopping.set()
        for executor in self._executors.values():
            executor.shutdown()
        for thread in self._threads:
            thread.join(_ANSWER_SECONDS)
        self.close()
        for node in reversed(self._executors):
            node.destroy_node()

    def _spin(self, executor: Executor) -> None:
        """Spin until the stop; what escapes rclpy's callbacks (a client that went away) is reported and not fatal."""
        while not self._stopping.is_set():
            try:
                executor.spin()
            except ExternalShutdownException:
                return
            except Exception as error:
                if not self._stopping.wait(_PAUSE_SECONDS):
                    self.report(error)

    def _close_jobs(self, why: str) -> None:
        jobs, self._jobs = self._jobs, None
        if jobs is not None:
            jobs.close(NotActiveError(why, self.get_name()))

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load and validate; a failure leaves the node unconfigured, to be configured again."""
        return self._transition(self.configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take jobs and publish."""

        def activate() -> None:
            self._last_failure = ""  # what kept the node from working is mended
            self._jobs = JobQueue(self.get_parameter("queue_size").value)
            self.activate()

        super().on_activate(state)
        result = self._transition(activate, None, state)
        if result != TransitionCallbackReturn.SUCCESS:
            self._close_jobs("the node could not be activated")
            super().on_deactivate(state)
        else:
            self.get_logger().info("active")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer all jobs with NOT_ACTIVE and fall silent."""

        def deactivate() -> None:
            self._close_jobs("the node was deactivated")
            self.deactivate()

        return self._transition(deactivate, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close what was opened: another process may have it."""
        return self._transition(self.close, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As deactivate and clean up, for good; a node that is not active has nothing to stop."""

        def shut_down() -> None:
            if self.is_active:
                self._close_jobs("the node was shut down")
                self.deactivate()
            self.close()

        return self._transition(shut_down, super().on_shutdown, state)

    def _transition(
        self,
        own: Callable[[], None],
        inherited: Callable[[LifecycleState], TransitionCallbackReturn] | None,
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        try:
            own()
        except MdfError as error:
            self.report(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            # rclpy would swallow it.
            self.report(error)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS if inherited is None else inherited(state)

    def _outlive_invalid_transitions(self) -> None:
        """In rclpy (Jazzy) a request for a transition that is not possible raises out of the executor."""
        service = self._service_change_state
        change_state = service.callback

        def guarded(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except Exception as error:
                self.get_logger().error(f"transition refused: {error}")
                response.success = False
                return response

        service.callback = guarded

    def _publish_diagnostics(self) -> None:
        jobs = self._jobs
        level, message = DiagnosticStatus.OK, self._last_job or "no job yet"
        if jobs is None:
            level, message = DiagnosticStatus.WARN, "not active"
        if self._last_failure:
            level, message = DiagnosticStatus.ERROR, self._last_failure
        try:
            more = self.diagnostics()
        except Exception as error:  # a disk that is gone must not silence the node
            more, level, message = {"diagnostics": error}, DiagnosticStatus.ERROR, str(error)
        values = {
            "state": self._state_machine.current_state[1],
            "jobs waiting or running": 0 if jobs is None else len(jobs),
            "jobs done": self._done,
            "errors": self._failed,
            "last job": self._last_job,
            "last error": self._last_error,
            "resident memory": f"{_resident_mib()} MiB",
            **more,
        }
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=message)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def _resident_mib() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 2**20


def run_managed_node(make_node: Callable[[], ManagedNode], description: str, args: Sequence[str] | None = None) -> int:
    """Run one node as a process until SIGINT or SIGTERM; the exit status."""

    def body() -> int:
        only_ros_arguments(description, sys.argv if args is None else ["node", *args])
        with ros_context(args) as stop:
            node = make_node()
            node.start()
            try:
                stop.wait()
            finally:
                node.stop()
        return DONE

    return exit_status(body)
