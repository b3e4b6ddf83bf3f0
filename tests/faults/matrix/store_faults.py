"""The way to the store on S3 fails: a proxy in between refuses, answers errors, is slow, or cuts uploads off."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tests.faults.matrix.cluster import Cluster
from tests.faults.matrix.faulty_proxy import FaultyProxy, Mode
from tests.faults.matrix.machine_faults import ClockJumps, TwoWorkersOneArtifact
from tests.faults.matrix.scenario import Fault, Injection
from tests.faults.matrix.worker_faults import WorkerKilledWithChildren

_WAIT_S = 60.0


class StoreFault(Fault):
    """A fault of the way to an S3 server; all processes of the dataset go through one proxy."""

    store = "S3"
    proxy: FaultyProxy

    @contextmanager
    def surround(self, cluster: Cluster) -> Iterator[None]:
        objects = cluster.start_objects()
        before = dict(os.environ)
        with FaultyProxy(objects.port).run() as self.proxy:
            cache = str(cluster.folder / "cache")
            cluster.store_env = {**objects.env(), "AWS_ENDPOINT_URL": self.proxy.url, "GENRE_CACHE_DIR": cache}
            # The checks of this process read the store, too.
            os.environ.update(cluster.store_env)
            cluster.restart_workers()
            try:
                yield
            finally:
                self.proxy.set_mode("ok")
                os.environ.clear()
                os.environ.update(before)
                cluster.store_env = {}
                cluster.restart_workers()

    def make_store(self, cluster: Cluster, number: int) -> str:
        objects = cluster.start_objects()
        return f"s3://{objects.bucket}/{type(self).__name__.lower()}-{number}"

    def hold(self, mode: Mode, seconds: float) -> None:
        """Keeps a mode for some seconds."""
        self.proxy.set_mode(mode)
        time.sleep(seconds)
        self.proxy.set_mode("ok")


class StoreUnreachable(StoreFault):
    """Nothing listens at the store's address for a minute."""

    name = "store unreachable for 60 s"
    how = "a proxy before the S3 server does not listen, and resets open connections, for 60 s"

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        moment = time.monotonic()
        self.hold("refuse", 60.0)
        return Injection(moment)


class StoreFails(StoreFault):
    """The store answers 503 to everything."""

    name = "store answers 503"
    how = "a proxy before the S3 server answers 503 SlowDown for 5 to 20 s"

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        moment = time.monotonic()
        before = self.proxy.hits["503"]
        self.hold("503", rng.uniform(5.0, 20.0))
        return Injection(moment) if self.proxy.hits["503"] > before else None


class StoreSlow(StoreFault):
    """The store takes seconds for every request."""

    name = "store slow"
    how = "a proxy before the S3 server delays every request by 3 s, for 5 to 20 s"

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        moment = time.monotonic()
        before = self.proxy.hits["slow"]
        self.hold("slow", rng.uniform(5.0, 20.0))
        return Injection(moment) if self.proxy.hits["slow"] > before else None


class UploadTruncated(StoreFault):
    """A connection breaks in the middle of an upload."""

    name = "truncated upload"
    how = "a proxy before the S3 server forwards half of an upload's body, and resets both connections"
    pause_s = (0.0, 4.0)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        before = self.proxy.hits["truncate"]
        self.proxy.set_mode("truncate")
        deadline = time.monotonic() + _WAIT_S
        while self.proxy.hits["truncate"] == before:
            if time.monotonic() > deadline or not cluster.is_dataset_running():
                self.proxy.set_mode("ok")
                return None
            time.sleep(0.02)
        return Injection(time.monotonic())


class WorkerKilledWithLease(WorkerKilledWithChildren, StoreFault):
    """A dead worker's lease is an object, which no system frees."""

    name = "worker killed with its run, S3"


class TwoWorkersOneObject(TwoWorkersOneArtifact, StoreFault):
    """Two workers that know of each other only by the objects of the store."""

    name = "two workers on one artifact, S3"


class ClockJumpsWithLeases(ClockJumps, StoreFault):
    """Leases in a bucket end by time, and the clocks of their holders jump."""

    name = "clock jump, S3"

    @contextmanager
    def surround(self, cluster: Cluster) -> Iterator[None]:
        with StoreFault.surround(self, cluster), ClockJumps.surround(self, cluster):
            yield
