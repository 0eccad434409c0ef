"""Where the scheduler is, and how to talk to it: a cluster of this machine's own, or one that runs elsewhere."""

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.security import Security

from lvba.errors import InputError, LvbaError
from workers import limits

_ATTEMPT_SECONDS = 3.0
_PAUSE_SECONDS = 0.5


class ClusterError(LvbaError):
    """The cluster cannot do the work: it is not there, or it keeps losing workers."""


@dataclass(frozen=True)
class Tls:
    """Files of the certificate authority that all parts of the cluster share, and of one's own certificate and key."""

    ca: Path
    cert: Path
    key: Path

    def security(self) -> Security:
        """What Dask wants to know.

        Raises InputError: a file that is not there.
        """
        for path in (self.ca, self.cert, self.key):
            if not path.is_file():
                raise InputError(path, "there is no such file", "give the PEM file")
        own = {
            f"tls_{role}_{part}": str(path)
            for role in ("client", "worker", "scheduler")
            for part, path in (("cert", self.cert), ("key", self.key))
        }
        return Security(tls_ca_file=str(self.ca), require_encryption=True, **own)


@dataclass(frozen=True)
class Scheduler:
    """A scheduler that is running."""

    address: str
    security: Security

    def connect(self, seconds: float, check: Callable[[], None]) -> Client:
        """A client with the workers' limits in force, tried for so many seconds.

        check: called between attempts; what it raises goes through
        Raises ClusterError: nothing answers.
        """
        limits.configure()
        deadline = time.monotonic() + seconds
        while True:
            check()
            try:
                return self._connect()
            except (OSError, TimeoutError) as error:
                if time.monotonic() > deadline:
                    raise ClusterError(f"{self.address}: no scheduler answers ({error})") from error
            time.sleep(_PAUSE_SECONDS)

    def _connect(self) -> Client:
        client = Client(
            self.address, security=self.security, timeout=_ATTEMPT_SECONDS, set_as_default=False, name="lvba"
        )
        client.register_plugin(limits.Limits())
        return client


def at(address: str, tls: Tls | None) -> Scheduler:
    """The scheduler at an address.

    Raises InputError: an address without protocol, or TLS files that do not fit it.
    """
    protocol = address.partition("://")[0]
    if protocol not in ("tcp", "tls") or not address.partition("://")[2]:
        raise InputError(
            address, "is not the address of a scheduler", "write tcp://HOST:PORT or tls://HOST:PORT"
        )
    if (protocol == "tls") != (tls is not None):
        mend = (
            "give --tls-ca, --tls-cert and --tls-key"
            if tls is None
            else "write tls://, or leave --tls-* away"
        )
        raise InputError(address, f"is {'not ' if tls else ''}encrypted", mend)
    return Scheduler(address, tls.security() if tls else Security())


@contextmanager
def local(workers: int, threads: int | None, memory_bytes: int | None = None) -> Iterator[Scheduler]:
    """A scheduler in this process with worker processes beside it, all ended with the block, or with this process.

    threads: of all workers together; None: as many as there are cores
    memory_bytes: of each worker; above it the process is ended and begins anew; None: its share of what there is
    Nobody else on the machine can talk to them: connections need a certificate that is in memory only.
    """
    limits.configure()
    security = Security.temporary()
    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host="127.0.0.1",
        security=security,
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        memory_limit=memory_bytes or limits.memory_per_process(workers),
        env={"NUMBA_NUM_THREADS": str(max(1, (threads or CPU_COUNT) // workers))},
        plugins=[limits.Limits()],
        silence_logs=logging.CRITICAL,
    )
    try:
        yield Scheduler(cluster.scheduler_address, security)
    finally:
        _kill_workers(cluster)
        # a worker that is just beginning anew takes longer; it ends with this process
        with suppress(TimeoutError):
            cluster.close(timeout=1)


def _kill_workers(cluster: LocalCluster) -> None:
    """At once, whatever they do: what is finished is in the store, and nobody waits for the rest."""
    for nanny in cluster.workers.values():
        if nanny.pid:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
