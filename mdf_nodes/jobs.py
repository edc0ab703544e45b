"""Heavy work, one job at a time in a thread of its own, so that callbacks return at once."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from mdf_core.errors import CancelledError, NotActiveError, QueueFullError
from mdf_core.progress import Progress, ProgressCallback, silent

T = TypeVar("T")
_FINISH_SECONDS = 1.0


class Job(Generic[T]):
    """One piece of work, answered exactly once: with a result, or with the exception that `result` raises.

    Parameters
    ----------
    work : callable
        Gets the job; hands `progress` on to the core, and calls `finish` before its first lasting effect.
    on_progress : callable
        Called in the worker's thread.
    on_error : callable
        Called once if the job ends with an exception, by whatever thread ended it.
    """

    def __init__(
        self,
        work: Callable[[Job[T]], T],
        on_progress: ProgressCallback = silent,
        on_error: Callable[[Exception], object] = lambda _: None,
    ) -> None:
        self._work = work
        self._on_progress = on_progress
        self._on_error = on_error
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._answered = self._finishing = False
        self._stop_with: Exception | None = None
        self._result: T | None = None
        self._error: Exception | None = None

    def progress(self, progress: Progress) -> None:
        """The core's progress callback: passes on, and raises once the job has been told to stop."""
        self.check()
        self._on_progress(progress)

    def check(self) -> None:
        """Raise if the job has been told to stop."""
        if self._stop_with is not None:
            raise self._stop_with

    def finish(self) -> None:
        """Raise if the job has been told to stop; from here on it cannot be: what it writes and publishes is whole."""
        with self._lock:
            self.check()
            self._finishing = True

    def stop_with(self, error: Exception) -> bool:
        """Let the job end with `error` at its next iteration; false: it is finishing and ends by itself."""
        with self._lock:
            if not self._finishing:
                self._stop_with = error
            return not self._finishing

    def wait(self, seconds: float) -> bool:
        """Whether the job has ended within `seconds`."""
        return self._ended.wait(seconds)

    def result(self) -> Any:
        """Wait for the end; the result of the work, or the exception that ended it."""
        self._ended.wait()
        if self._error is not None:
            raise self._error
        return self._result

    def run(self) -> None:
        """Do the work in the calling thread."""
        try:
            self.check()
            result = self._work(self)
        except Exception as error:
            self.answer(error=error)
        else:
            self.answer(result=result)

    def answer(self, result: T | None = None, error: Exception | None = None) -> None:
        """End the job, unless it has an answer already."""
        with self._lock:
            if self._answered:
                return
            self._answered = True
        self._result, self._error = result, error
        try:
            if error is not None:
                self._on_error(error)
        finally:
            self._ended.set()


class JobQueue:
    """Jobs wait here, at most `size` of them, for the one thread that runs them in turn."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._waiting: deque[Job[Any]] = deque()
        self._running: Job[Any] | None = None
        self._closed: NotActiveError | None = None
        self._changed = threading.Condition()
        # A daemon: linear algebra under way cannot be interrupted, and must not keep the process from ending.
        threading.Thread(target=self._run, name="jobs", daemon=True).start()

    def __len__(self) -> int:
        """How many jobs wait or run."""
        with self._changed:
            return len(self._waiting) + (self._running is not None)

    @property
    def has_room(self) -> bool:
        """Whether a job would be taken now, if the queue is open."""
        with self._changed:
            return len(self._waiting) < self._size

    def full(self) -> QueueFullError:
        """What is raised when there is no room."""
        return QueueFullError(f"{self._size} jobs are waiting", "queue", "try again later, or raise queue_size")

    def submit(self, job: Job[T]) -> Job[T]:
        """Queue a job.

        Raises
        ------
        NotActiveError
            The queue is closed.
        QueueFullError
            `size` jobs are waiting already.
        """
        with self._changed:
            if self._closed is not None:
                raise self._closed
            if len(self._waiting) >= self._size:
                raise self.full()
            self._waiting.append(job)
            self._changed.notify()
        return job

    def cancel(self, job: Job[Any]) -> None:
        """Answer a waiting job with `CancelledError` at once, a running one at its next iteration."""
        error = CancelledError("cancelled by the client", "job")
        with self._changed:
            waits = job in self._waiting
            if waits:
                self._waiting.remove(job)
        if waits:
            job.answer(error=error)
        else:
            job.stop_with(error)

    def close(self, error: NotActiveError) -> None:
        """Take no more jobs and answer all with `error`, now; the running one stops at its next iteration.

        If it is finishing already, a second is waited for its end; then it is answered all the same: a stop must not
        take long.
        """
        with self._changed:
            if self._closed is not None:
                return
            self._closed = error
            jobs = list(self._waiting)
            self._waiting.clear()
            if self._running is not None:
                jobs.insert(0, self._running)
            self._changed.notify()
        for job in jobs:
            if not job.stop_with(error):
                job.wait(_FINISH_SECONDS)
            job.answer(error=error)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._running = None
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed is not None:
                    return
                self._running = job = self._waiting.popleft()
            job.run()
            # The queue must not keep the clouds of the last job alive until the next one comes.
            del job
