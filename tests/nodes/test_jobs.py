"""The job queue: one job at a time, each answered exactly once, whenever it is cancelled or the queue closed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from mdf_core.errors import CancelledError, NotActiveError, QueueFullError
from mdf_core.progress import Progress
from mdf_nodes.jobs import Job, JobQueue

CLOSED = NotActiveError("closed", "test")


class Steps:
    """Work that stands still where a test wants it."""

    def __init__(self, finishing: bool = False) -> None:
        self.started, self.go_on = threading.Event(), threading.Event()
        self._finishing = finishing

    def __call__(self, job: Job[Any]) -> str:
        if self._finishing:
            job.finish()
        self.started.set()
        assert self.go_on.wait(5.0)
        if not self._finishing:
            job.progress(Progress("prepare", 0.5, 1, 0.0))
        return "done"


@pytest.fixture
def queue() -> JobQueue:
    return JobQueue(2)


def running(queue: JobQueue, steps: Steps, on_error: Callable[[Exception], object] = lambda _: None) -> Job[Any]:
    job = queue.submit(Job(steps, on_error=on_error))
    assert steps.started.wait(5.0)
    return job


def test_jobs_run_in_turn_and_each_returns_its_own_result(queue: JobQueue) -> None:
    steps = Steps()
    first = running(queue, steps)
    others = [queue.submit(Job(lambda _, number=number: number)) for number in range(2)]
    assert len(queue) == 3
    steps.go_on.set()
    assert [first.result(), *(job.result() for job in others)] == ["done", 0, 1]


def test_a_full_queue_refuses_and_the_jobs_in_it_are_done(queue: JobQueue) -> None:
    steps = Steps()
    job = running(queue, steps)
    waiting = [queue.submit(Job(lambda _: "waited")) for _ in range(2)]
    with pytest.raises(QueueFullError):
        queue.submit(Job(lambda _: "too many"))
    steps.go_on.set()
    assert [each.result() for each in (job, *waiting)] == ["done", "waited", "waited"]


def test_a_cancelled_job_ends_at_its_next_iteration_and_a_waiting_one_at_once(queue: JobQueue) -> None:
    steps = Steps()
    job, waiting = running(queue, steps), queue.submit(Job(lambda _: "never"))
    queue.cancel(waiting)
    with pytest.raises(CancelledError):
        waiting.result()
    queue.cancel(job)
    assert not job.wait(0.0)
    steps.go_on.set()
    with pytest.raises(CancelledError):
        job.result()


def test_closing_answers_all_at_once_and_only_once(queue: JobQueue) -> None:
    steps, errors = Steps(), []
    job = running(queue, steps, errors.append)
    waiting = queue.submit(Job(lambda _: "never", on_error=errors.append))
    queue.close(CLOSED)
    assert errors == [CLOSED, CLOSED]
    steps.go_on.set()
    for each in (job, waiting):
        with pytest.raises(NotActiveError):
            each.result()
    with pytest.raises(NotActiveError):
        queue.submit(Job(lambda _: "late"))
    assert errors == [CLOSED, CLOSED]


def test_a_job_that_is_finishing_is_neither_cancelled_nor_cut_off_by_closing(queue: JobQueue) -> None:
    steps, errors = Steps(finishing=True), []
    job = running(queue, steps, errors.append)
    queue.cancel(job)
    closing = threading.Thread(target=queue.close, args=(CLOSED,))
    closing.start()
    assert not job.wait(0.05)
    steps.go_on.set()
    closing.join(5.0)
    assert job.wait(0.0), "closing waits for it"
    assert (job.result(), errors) == ("done", [])


def test_a_failed_job_tells_its_error_once_and_the_next_one_runs(queue: JobQueue) -> None:
    errors: list[Exception] = []

    def fail(_: Job[Any]) -> None:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        queue.submit(Job(fail, on_error=errors.append)).result()
    assert [str(error) for error in errors] == ["broken"]
    assert queue.submit(Job(lambda _: "next")).result() == "next"
