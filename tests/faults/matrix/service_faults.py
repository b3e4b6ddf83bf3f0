"""The server and its database go away and come back."""

from __future__ import annotations

import random
import time

from tests.faults.matrix.cluster import Cluster
from tests.faults.matrix.scenario import Fault, Injection


class ServerKilled(Fault):
    """Prefect's server dies without a word and comes back where it was."""

    name = "server killed"
    how = "kill −9 of all processes of Prefect's server, started again after 0 to 5 s"
    pause_s = (2.0, 8.0)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        moment = time.monotonic()
        cluster.server.kill()
        time.sleep(rng.uniform(0.0, 5.0))
        cluster.server.start()
        return Injection(moment)


class DatabaseRestarted(Fault):
    """PostgreSQL disconnects all clients and comes back."""

    name = "database restarted"
    how = "fast shutdown of PostgreSQL, started again after 0 to 10 s"
    pause_s = (2.0, 8.0)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        moment = time.monotonic()
        cluster.postgres.stop()
        time.sleep(rng.uniform(0.0, 10.0))
        cluster.postgres.start()
        return Injection(moment)
