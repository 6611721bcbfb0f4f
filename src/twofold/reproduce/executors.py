"""Where cells run: processes of this machine, or jobs of a Slurm cluster."""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any, Protocol, final, runtime_checkable

from twofold.errors import TwofoldError, install_command
from twofold.reproduce.cells import Work, in_own_process, run_cell


@runtime_checkable
class Job(Protocol):
    """A cell at work."""

    def finished(self) -> bool:
        """Whether it has ended, well or not."""
        ...

    def stop(self) -> None:
        """Asks it to store its state and to end."""
        ...

    def failure(self) -> str:
        """Of one that has finished without writing why: how its process ended; empty where it ended well."""
        ...


@runtime_checkable
class Executor(Protocol):
    """Starts cells."""

    at_once: int
    """How many cells it takes at the same time."""

    def start(self, folder: Path) -> Job:
        """Begins a cell, or goes on with it."""
        ...


@final
class LocalExecutor:
    """A process a cell, `workers` at the same time; one that is killed or crashes takes no other along."""

    def __init__(self, workers: int, threads: int | None = None, work: Work | None = None) -> None:
        """Workers share the machine's threads evenly unless `threads` says how many each of them has."""
        self.at_once = workers
        self._threads = threads or max(_threads_here() // workers, 1)
        self._work = work

    def start(self, folder: Path) -> Job:
        """See `Executor.start`."""
        context = multiprocessing.get_context("spawn")
        words = (str(folder), self._threads, self._work, os.getpid())
        process = context.Process(target=in_own_process, args=words)
        with _no_interrupt():
            process.start()
        return _LocalJob(process)


@final
class _LocalJob:
    def __init__(self, process: Any) -> None:
        self._process = process

    def finished(self) -> bool:
        return not self._process.is_alive()

    def stop(self) -> None:
        if self._process.is_alive():
            os.kill(self._process.pid, signal.SIGINT)

    def failure(self) -> str:
        self._process.join()
        code = self._process.exitcode
        if code == 0:
            return ""
        if code == -signal.SIGKILL:
            return "its process was killed, most often because memory ran out; use fewer --workers"
        return f"its process ended with code {code}"


@final
class SlurmExecutor:
    """A Slurm job a cell, by submitit; `cluster` may also be its "local" or "debug", which need no Slurm."""

    def __init__(
        self, logs: Path, cluster: str = "slurm", hours: float = 24.0, gpus: int = 0, at_once: int = 256,
        work: Work | None = None, **parameters: Any,
    ) -> None:  # fmt: skip
        """Logs go to a folder that all machines see; `parameters` go to submitit, such as slurm_partition="gpu".

        Raises:
            TwofoldError: submitit is not installed, or there is no Slurm here.
        """
        try:
            import submitit
        except ModuleNotFoundError:
            raise TwofoldError(
                f"--cluster needs the package submitit, which is not installed; run: {install_command('slurm')}"
            ) from None
        self.at_once, self._work = (1 if cluster == "debug" else at_once), work
        try:
            self._executor = submitit.AutoExecutor(folder=logs, cluster=cluster)
            self._executor.update_parameters(
                name="twofold", timeout_min=round(60 * hours), gpus_per_node=gpus, tasks_per_node=1, **parameters
            )
        except (RuntimeError, ValueError, TypeError, NameError) as error:
            raise TwofoldError(f"submitit cannot use {cluster} here: {error}.") from error

    def start(self, folder: Path) -> Job:
        """See `Executor.start`."""
        return _SlurmJob(self._executor.submit(run_cell, str(folder), None, self._work))


@final
class _SlurmJob:
    def __init__(self, job: Any) -> None:
        self._job = job

    def finished(self) -> bool:
        if not self._job.done():
            return False
        self._job.wait()  # A job of the kind "debug" does its work here.
        return True

    def stop(self) -> None:
        if not self._job.done():
            self._job.cancel()

    def failure(self) -> str:
        error = self._job.exception()
        return "" if error is None else f"its job ended with {type(error).__name__}; its logs are in {self._job.paths}"


@contextlib.contextmanager
def _no_interrupt() -> Generator[None, None, None]:
    """What is started meanwhile has Ctrl-C held back until it lets it through (`in_own_process`)."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _threads_here() -> int:
    """Threads that this process may use."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdigit() and int(given) else len(os.sched_getaffinity(0))
