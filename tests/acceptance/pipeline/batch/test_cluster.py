"""Real processes of Dask distributed: the same bytes as here."""

import shutil
import socket
import subprocess
import threading

import pytest
from support.dask_cluster import local_cluster
from support.missing import import_but_fail_in_ci
from support.recorded_footage import contents, job_of

from pipeline.batch.run import decode_job
from pipeline.errors import ClusterError

import_but_fail_in_ci("distributed")
# Not ours: what Dask leaves behind when its processes are killed.
pytestmark = [
    pytest.mark.usefixtures("kernels_on_disk"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


def test_the_same_bytes_as_here(folder, here, tmp_path):
    store = tmp_path / "result.zarr"
    with local_cluster(2) as cluster:
        decode_job(job_of(folder, store), cluster=cluster.scheduler_address)
    assert contents(store) == here


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the keys")
def test_by_tls(folder, here, tmp_path):
    """As `docs/video.md` says: who has no certificate of the run's own is not let in."""
    import dask

    keys = {"cert": str(tmp_path / "cert.pem"), "key": str(tmp_path / "key.pem")}
    made = ("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=colorphase")
    arguments = ["openssl", *made, "-keyout", keys["key"], "-out", keys["cert"]]
    subprocess.run(arguments, check=True, capture_output=True)
    tls = {"distributed.comm.tls.ca-file": keys["cert"], "distributed.comm.require-encryption": True}
    tls |= {
        f"distributed.comm.tls.{who}.{name}": keys[name] for who in ("scheduler", "worker", "client") for name in keys
    }
    store = tmp_path / "result.zarr"
    with dask.config.set(tls):
        with local_cluster(1, protocol="tls") as cluster:
            address = cluster.scheduler_address
            assert address.startswith("tls://")
            decode_job(job_of(folder, store), cluster=address)
            with pytest.raises(ClusterError, match="one that does not know us"):
                decode_job(job_of(folder, tmp_path / "other.zarr"), cluster=address.replace("tls", "tcp"))
    assert contents(store) == here


def test_no_scheduler(folder, tmp_path):
    """It is known at once where nobody listens."""
    with pytest.raises(ClusterError, match=r"no scheduler answers at tcp://127\.0\.0\.1:9 \(.*refused"):
        decode_job(job_of(folder, tmp_path / "result.zarr"), cluster="tcp://127.0.0.1:9")


def test_something_else_listens(folder, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"

        def answer():
            for _ in range(2):  # the first only asks whether anybody is there
                connection, _ = server.accept()
                with connection:
                    connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        answering = threading.Thread(target=answer)
        answering.start()
        with pytest.raises(ClusterError, match="is no Dask scheduler"):
            decode_job(job_of(folder, tmp_path / "result.zarr"), cluster=address)
        answering.join(10)


def test_no_worker_is_left(folder, tmp_path, monkeypatch):
    """A scheduler alone waits for another one; we do not wait for ever."""
    monkeypatch.setattr("pipeline.batch.cluster._ALONE_S", 1)
    job = job_of(folder, tmp_path / "result.zarr")
    with local_cluster(1) as cluster:
        cluster.scale(0)
        with pytest.raises(ClusterError, match="no worker is left: start one"):
            decode_job(job, cluster=cluster.scheduler_address)
