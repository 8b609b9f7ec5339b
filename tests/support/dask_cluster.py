"""A Dask cluster on this machine, with processes of its own, on the loopback interface."""

import logging
from contextlib import contextmanager


@contextmanager
def local_cluster(n_workers, **options):
    """Start this many workers, with further options of Dask's, and give the cluster."""
    import distributed

    with distributed.LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        # Its server for pages about itself is there in any case, on a port that another one may have.
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        memory_limit=0,
        silence_logs=logging.CRITICAL,
        **options,
    ) as cluster:
        cluster.scale(n_workers)
        cluster.wait_for_workers(n_workers, 120)
        yield cluster
